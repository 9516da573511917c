"""What a saved adapter says of itself, in words and for programs: the scene it was made for."""

import shlex
from dataclasses import dataclass
from typing import Any

DENOISER, OTHERS = "sha256", "others_sha256"
"""Keys of the hashes of the weights that an adapter belongs to: the denoiser's, and those of the
networks that tell it what to paint.
"""


@dataclass(frozen=True)
class AdapterOrigin:
    """What an adapter was made from."""

    scene: str
    """Its address, the same from any folder."""
    inputs: list[str]
    """Names of the frames that it has learnt."""
    weights: str
    """Model folder, or a packaged model's name."""
    options: dict[str, Any]
    """By dotted key."""
    outcome: str
    """How its training ended."""


_CARD = """---
library_name: peft
tags:
- lora
- novel-view-synthesis
---
# An adapter for one scene

Low-rank additions to the denoiser of a view-extrapolation model, trained on photographs of one
scene alone. It paints new views of that scene; others it may paint worse than the model does.

| | |
|---|---|
{rows}

`base.json` says the same for programs. The adapter is refused upon other weights than these.

## Use

```bash
python -m extrap_train task=view category=NAME {command} orbit=360 adapter=FOLDER
```

```python
from extrap_train.tasks.view import open_generator

generator = open_generator({weights!r}, adapter="FOLDER")
```

Any `category` will do. In plain peft: `PeftModel.from_pretrained(unet, "FOLDER")`.
"""


def model_card(origin: AdapterOrigin, hashes: dict[str, str]) -> str:
    """The `README.md` of an adapter's folder."""
    rows = {
        "scene": f"`{origin.scene}`",
        "photographs": ", ".join(f"`{name}`" for name in origin.inputs),
        "weights": f"`{origin.weights}`",
        "SHA-256 of the denoiser": f"`{hashes[DENOISER]}`",
        "SHA-256 of its other networks": f"`{hashes[OTHERS]}`",
        "training": origin.outcome,
        "options": ", ".join(f"`{name}={value}`" for name, value in origin.options.items()),
    }
    options = {
        "weights": origin.weights,
        "scene": origin.scene,
        "input_frames": f"[{','.join(origin.inputs)}]",
    }
    return _CARD.format(
        rows="\n".join(f"| {name} | {value} |" for name, value in rows.items()),
        command=" ".join(shlex.quote(f"{name}={value}") for name, value in options.items()),
        weights=origin.weights,
    )
