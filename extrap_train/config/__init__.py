"""The configuration tree as plain dataclasses: every option, its type, unit, range and meaning.

Light on purpose (no torch), so that `--help` is instant. YAMLs under `conf/` choose among the
variants of a group; this package says what may stand in them.
"""

from extrap_train.config.checks import (
    check_shards_address,
    notes,
    require_published,
    required_file,
    required_folder,
    sampler_for,
    validate,
    validate_model,
)
from extrap_train.config.commands import (
    ANY_CATEGORY_TASKS,
    PAIR_TASKS,
    TASKS,
    DataPrepConfig,
    LauncherConfig,
    LocalConfig,
    LoggerConfig,
    RayConfig,
    SlurmConfig,
    TrainConfig,
    TrainerConfig,
    ValidationConfig,
)
from extrap_train.config.data_sources import (
    AlikedMatcherConfig,
    CategoryConfig,
    Co3dConfig,
    DataConfig,
    DatasetDepthConfig,
    DepthConfig,
    DownloadConfig,
    FilesDepthConfig,
    FlowMatcherConfig,
    FoldersConfig,
    LoftrMatcherConfig,
    Mast3rConfig,
    Mast3rMatcherConfig,
    MatcherConfig,
    MonocularConfig,
    OwnDepthConfig,
    OwnMatcherConfig,
    PrepConfig,
    SiftPosesConfig,
    StereoConfig,
    SyntheticConfig,
    Uco3dConfig,
)
from extrap_train.config.model_options import (
    FAMILIES,
    NEAREST_ALONE,
    ClipConfig,
    ModelConfig,
    SamplerConfig,
    SamplerOptions,
    UNetConfig,
    VaeConfig,
)
from extrap_train.config.options import (
    MISSING,
    MODEL_CONFIG,
    PACKAGED_MODELS,
    Option,
    check_options,
    dotted,
    options_of,
    packaged_names,
    resolve_path,
    resolve_paths,
)
from extrap_train.config.scene_options import (
    CompletionConfig,
    ConfidenceConfig,
    LoraConfig,
    SceneOptions,
    SplatsConfig,
)
from extrap_train.config.table_options import (
    CAPTURE_SOURCES,
    DRAWS,
    LPIPS_NETS,
    METRICS,
    CapturesConfig,
    MethodConfig,
    MetricConfig,
    QuickConfig,
    RulesConfig,
    ScoringConfig,
    TableConfig,
    metric_direction,
)
