"""What the tasks about one scene read: which scene, from which views, with which weights."""

from dataclasses import dataclass, field

from extrap_train.config.options import option


@dataclass
class LoraConfig:
    """How a model is adapted to a scene (paper II-B)."""

    rank: int = option(16, "rank of the adapter", low=1, high=1024)
    convolutions: bool = option(
        True, "adapt the denoiser's convolutions as well as its attention projections"
    )
    virtual_references: int = option(
        8,
        "extra views per input, warped from the inputs, to train on; 0: the inputs' own pairs only",
        low=0,
        high=1000,
    )
    learning_rate: float | None = option(
        None, "learning rate; null: the model's own", low=1e-9, high=1
    )
    batch_size: int = option(8, "views per step", low=1)
    steps: int = option(5000, "most steps; minutes or patience usually end it sooner", low=1)
    validate_every: int = option(25, "steps between validations on what is held out", low=1)
    patience: int = option(8, "validations without a gain after which adaptation ends", low=1)


@dataclass
class SceneOptions:
    """One scene: its views, the weights, and what is asked of them."""

    scene: str | None = option(
        None,
        "co3d:ROOT/category/sequence, synthetic:category/0003, or a folder with transforms.json "
        "or a COLMAP model",
    )
    inputs: int | None = option(
        None,
        "input views, spread around the scene, without the one that pose names; null: all",
        low=1,
        high=10_000,
    )
    input_frames: list[str] = option([], "names of the input views, instead of a number")
    weights: str | None = option(
        None,
        "model folder, published checkpoint of the model= chosen, or packaged model (base, "
        "ours-hydrant); null: the category's latest run, or its packaged model",
    )
    adapter: str | None = option(
        None, "folder of a scene's adapter, as task=scene writes it, to apply to the weights"
    )
    lora: LoraConfig = field(default_factory=LoraConfig)
    minutes: float = option(
        3.0, "time that task=scene may train for", unit="minutes", low=0.001, high=10_000
    )
    pose: str | None = option(
        None, "view that task=view makes: a frame's name, or a file laid out like transforms.json"
    )
    orbit: float | None = option(
        None,
        "angle around the scene that task=view walks, instead of one pose",
        unit="degrees",
        low=1,
        high=360,
    )
    frames: int = option(24, "views along the orbit", low=1, high=10_000)
    painted_at_once: int = option(
        16, "views denoised at a time: memory against time, same pictures", low=1, high=10_000
    )
