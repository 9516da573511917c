"""The configuration tree as plain dataclasses: every option, its type, unit, range and meaning.

Light on purpose (no torch), so that `--help` is instant. YAMLs under `conf/` choose among the
variants of a group; this package says what may stand in them.
"""

from extrap_train.config.benchmark import (
    CAPTURE_SOURCES,
    DRAWS,
    LPIPS_NETS,
    METRICS,
    CapturesConfig,
    MethodConfig,
    QuickConfig,
    RulesConfig,
    ScoringConfig,
    TableConfig,
    metric_direction,
)
from extrap_train.config.checks import (
    notes,
    require_published,
    required_file,
    sampler_for,
    validate,
    validate_model,
)
from extrap_train.config.commands import PAIR_TASKS, TASKS, DataPrepConfig, TrainConfig
from extrap_train.config.completion import CompletionConfig, ConfidenceConfig, SplatsConfig
from extrap_train.config.data import (
    CATEGORIES,
    CategoryConfig,
    Co3dConfig,
    DataConfig,
    PrepConfig,
    SyntheticConfig,
)
from extrap_train.config.depth import (
    DatasetDepthConfig,
    DepthConfig,
    Mast3rConfig,
    MonocularConfig,
    StereoConfig,
)
from extrap_train.config.launcher import LauncherConfig, LocalConfig, SlurmConfig
from extrap_train.config.matching import (
    AlikedMatcherConfig,
    FlowMatcherConfig,
    LoftrMatcherConfig,
    MatcherConfig,
)
from extrap_train.config.model import (
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
    Option,
    check_options,
    dotted,
    options_of,
    resolve_path,
    resolve_paths,
)
from extrap_train.config.scene import LoraConfig, SceneOptions
from extrap_train.config.training import TrainerConfig, ValidationConfig
