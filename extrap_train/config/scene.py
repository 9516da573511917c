"""What the tasks about one scene read: which scene, from which views, with which weights."""

from dataclasses import dataclass, field


@dataclass
class LoraConfig:
    """How a model is adapted to a scene (paper II-B, METHOD section 4)."""

    rank: int = 16
    convolutions: bool = True
    """Adapt the denoiser's convolutions, too, not its attention projections alone."""
    virtual_references: int = 8
    """Beside each input view, warped from the inputs, that it is painted from in training; 0 trains
    on the inputs' own N(N − 1) pairs.
    """
    learning_rate: float | None = None
    """Null takes the model's own."""
    batch_size: int = 8
    steps: int = 5000
    """Most steps; time or what is held out usually ends it sooner."""
    validate_every: int = 25
    patience: int = 8
    """Validations on what is held out without a gain after which it ends."""


@dataclass
class SceneOptions:
    """One scene: its views, the weights, and what is asked of them."""

    scene: str | None = None
    """`co3d:ROOT/category/sequence`, `synthetic:category/0003`, or a folder with a transforms.json
    or a COLMAP model.
    """
    inputs: int | None = None
    """Input views, spread around the scene; null takes every frame. The one that `pose` names is
    none of them.
    """
    input_frames: list[str] = field(default_factory=list)
    """Names of the input views, instead of a number."""
    weights: str | None = None
    """Model folder, a packaged model's name (`base`, `ours-hydrant`), or a published checkpoint of
    the model that `model=` describes (`model=zeronvs weights=zeronvs.ckpt`); null takes the
    category's newest run, and the packaged model of the category before there is one.
    """
    adapter: str | None = None
    """Folder of a scene's adapter, as `task=scene` leaves it, to put upon the weights."""
    lora: LoraConfig = field(default_factory=LoraConfig)
    minutes: float = 3.0
    """Time that `task=scene` may train for."""
    pose: str | None = None
    """Query of `task=view`: a frame's name, or a JSON file laid out like transforms.json."""
    orbit: float | None = None
    """Degrees around the scene that `task=view` walks, instead of one pose."""
    frames: int = 24
    """Views along the orbit."""
    painted_at_once: int = 16
    """Views that are denoised at a time; fewer take less memory and give the same pictures."""
