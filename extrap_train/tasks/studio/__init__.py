"""`task=studio`: a page on which a scene is opened, looked at, completed and downloaded."""

from extrap_train.config import TrainConfig
from extrap_train.errors import InputError
from extrap_train.terminal import terminal


def run(config: TrainConfig) -> None:
    """Serve the page until Ctrl-C; all work is done in this thread, as a command's own."""
    try:
        from extrap_train.tasks.studio.studio_page import Studio
    except ModuleNotFoundError as error:
        if error.name not in ("viser", "websockets"):
            raise
        raise InputError('task=studio needs viser: pip install "extrap-train[studio]"') from None
    with Studio(config) as studio:
        terminal().print(f"studio: {studio.url} (Ctrl-C ends it)")
        try:
            while True:
                studio.do_next()
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "the page is closed; a completion that it interrupts goes on where it was"
            ) from None
