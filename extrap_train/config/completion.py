"""How a scene is completed."""

from dataclasses import dataclass, field


@dataclass
class ConfidenceConfig:
    """What keeps misaligned pixels out of the map; each part can be switched off."""

    repair: bool = True
    """Where a new depth contradicts a surer one in the map, the map's is taken."""
    free_space: bool = True
    """Pixels in front of what a surer view has seen are left out."""
    support: bool = True
    """A view's confidence is scaled by the share of it that the map confirms, and is less where few
    of its edges measure a pixel."""
    votes: bool = True
    """Points that more views contradict than confirm are left out of the cloud."""
    regenerate: bool = True
    """A view that contradicts the map is generated again with another seed."""
    reject: bool = True
    """What a view that still contradicts the map shows for the first time is left out."""
    attempts: int = 3
    """Most pictures of one view; the best one is kept."""
    least_agreement: float = 0.5
    """Share of a view's testable pixels that must agree with the map."""
    least_confidence: float = 0.1
    """Of a point of the cloud."""


@dataclass
class SplatsConfig:
    """The Gaussians fitted to a completed scene's views: `splats.ply`."""

    fit: bool = True
    """Whether they are."""
    iterations: int = 500
    """Of 3DGS's optimisation."""
    count: int = 10_000
    """Most Gaussians."""


@dataclass
class CompletionConfig:
    """From a few posed photographs to a full turn (paper II-C; METHOD §5)."""

    draw: str = "one_sided"
    """How `inputs` photographs are drawn: `one_sided` neighbours, or `spread` around the scene."""
    poses: str = "orbit"
    """Where new views are made: on the `orbit` fitted to the inputs, or at the `capture`'s other
    poses."""
    step_deg: float = 30.0
    """Angle from view to view around the orbit; gaps are divided evenly."""
    edges: int = 4
    """Known views that a new one is aligned to."""
    tolerance: float = 0.01
    """Relative difference of depth up to which two views show the same surface."""
    generator: str = "model"
    """`model` samples pictures; `exact` renders them and their depth, synthetic scenes only."""
    confidence: ConfidenceConfig = field(default_factory=ConfidenceConfig)
    splats: SplatsConfig = field(default_factory=SplatsConfig)
    exact_size: int = 128
    """Side of the pictures of `generator=exact`, in pixels; a model has its own."""
    held_out: int = 20
    """Most photographs that are no inputs with which views generated at their poses are compared.
    """
    dry_run: bool = False
    """Print and draw the plan, and stop."""
    viewer: bool = False
    """Show the growing cloud in a browser; needs the extra `viewer`."""
    host: str = "127.0.0.1"
    """Address that the viewer listens on: this machine alone; `0.0.0.0` lets others see it, too."""
    port: int = 8080
    """Port of the viewer, or the next free one."""
