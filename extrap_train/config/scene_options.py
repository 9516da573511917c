"""What the tasks about one scene read, and how a scene is completed."""

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
        "co3d:ROOT/category/sequence, uco3d:ROOT/…/sequence, synthetic:category/0003, a "
        "folder with transforms.json, a COLMAP model or photographs alone, or a video",
    )
    inputs: int | None = option(
        None,
        "number of input views, spread around the scene (task=complete: neighbouring, unless "
        "complete.draw=spread), without the one that pose names; null: all",
        low=1,
        high=10_000,
    )
    input_frames: list[str] = option([], "names of the input views, instead of a number")
    weights: str | None = option(
        None,
        "model folder, published checkpoint, packaged model (base) or repository of the hub "
        "(org/name@revision); null: the category's latest run, or its packaged model",
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
    sample_batch_size: int = option(
        16, "views denoised at a time: memory against time, same pictures", low=1, high=10_000
    )


@dataclass
class ConfidenceConfig:
    """What keeps misaligned pixels out of the map; each part can be switched off."""

    repair: bool = option(True, "replace a new depth by the map's where the map's is more certain")
    free_space: bool = option(
        True, "leave out pixels in front of surfaces that a more certain view has seen"
    )
    support: bool = option(
        True, "scale a view's confidence by the share of it that the map confirms"
    )
    votes: bool = option(
        True, "leave out points of the cloud that more views contradict than confirm"
    )
    regenerate: bool = option(
        True, "generate a view that contradicts the map again with another seed"
    )
    reject: bool = option(
        True, "leave out what a view that still contradicts the map shows for the first time"
    )
    attempts: int = option(
        3, "most attempts at one view, of which the best is kept", low=1, high=100
    )
    least_agreement: float = option(
        0.5, "share of a view's testable pixels that must agree with the map", low=0, high=1
    )
    least_confidence: float = option(
        0.2, "confidence below which a point is left out of the cloud", low=0, high=1
    )


@dataclass
class SplatsConfig:
    """The Gaussians fitted to a completed scene's views: `splats.ply`, `splats.spz`."""

    fit: bool = option(True, "fit Gaussians to the completed views (splats.ply)")
    iterations: int = option(500, "optimisation steps of 3DGS", low=1, high=1_000_000)
    count: int = option(10_000, "most Gaussians", low=1, high=10_000_000)
    spz: bool = option(False, "also write them as splats.spz, for viewers on the web")


@dataclass
class CompletionConfig:
    """From a few posed photographs to a full turn (paper II-C)."""

    draw: str = option(
        "one_sided",
        "how task=complete chooses its inputs: neighbours, or spread around the scene",
        choices=("one_sided", "spread"),
    )
    poses: str = option(
        "orbit",
        "where new views are made: on the orbit fitted to the inputs, or at the capture's poses",
        choices=("orbit", "capture"),
    )
    step_deg: float = option(
        30.0, "angle between neighbouring views of the orbit", unit="degrees", low=1, high=180
    )
    references: str = option(
        "photographs",
        "what new views are generated from: the photographs alone, or from generated views, too, "
        "as in the paper",
        choices=("photographs", "all"),
    )
    symmetry: bool = option(
        True,
        "mirror the photographs in the object's planes of symmetry where they confirm any; needs "
        "masks of the object",
    )
    edges: int = option(4, "known views that a new one is aligned to", low=1, high=64)
    tolerance: float = option(
        0.01,
        "relative difference in depth up to which two views show the same surface",
        low=1e-4,
        high=0.5,
    )
    generator: str = option(
        "model",
        "what makes new views: the model, or the exact renderer of a synthetic scene",
        choices=("model", "exact"),
    )
    depth_network: str | None = option(
        None,
        "weights of task=depth that give generated views their depth; null: the depth source does",
    )
    confidence: ConfidenceConfig = field(default_factory=ConfidenceConfig)
    splats: SplatsConfig = field(default_factory=SplatsConfig)
    exact_size: int = option(
        128,
        "side of the views of complete.generator=exact; a model has its own",
        unit="pixels",
        low=16,
        high=4096,
    )
    held_out: int = option(
        20,
        "most photographs that are not inputs and are compared with views at their poses",
        low=0,
    )
    dry_run: bool = option(False, "print and draw the plan, and stop")
    viewer: bool = option(False, "show the growing cloud in a browser; needs the extra `viewer`")
    host: str = option(
        "127.0.0.1",
        "address that the viewer listens on: this machine only; 0.0.0.0 lets others see it too",
    )
    port: int = option(8080, "port of the viewer, or the next free one", low=1, high=65535)


@dataclass
class StudioConfig:
    """Where the page of task=studio is."""

    host: str = option(
        "127.0.0.1",
        "address that the page listens on: this machine only; 0.0.0.0 lets others use it too",
    )
    port: int = option(8090, "port of the page, or the next free one", low=1, high=65535)
