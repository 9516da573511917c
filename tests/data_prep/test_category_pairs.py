"""Which sequences a category is trained and tested on."""

import json
from pathlib import Path

from captures import write_capture

from data_prep.category_pairs import prepare_category
from extrap_train.config import Co3dConfig, DatasetDepthConfig, FlowMatcherConfig, PrepConfig


def test_a_set_list_says_what_is_trained_and_tested_on(tmp_path: Path) -> None:
    write_capture(tmp_path, ("a", "b", "c", "d", "unlisted"), frames=12)
    subsets = {"train": ["a", "c"], "val": [], "test": ["b", "d"]}
    content = {k: [[name, 1, f"cup/{name}/1.jpg"] for name in v] for k, v in subsets.items()}
    (tmp_path / "cup/set_lists/set_lists_fewview_dev.json").write_text(json.dumps(content))
    prepared = prepare_category(
        "cup",
        Co3dConfig(root=str(tmp_path), test_sequences=1, set_list="fewview_dev"),
        DatasetDepthConfig(),
        PrepConfig(image_size=16, max_uses=2, correct=False),
        output=tmp_path / "outputs",
        workers=1,
        matcher=FlowMatcherConfig(),
    )
    assert prepared.roles == {"cup/a": "train", "cup/b": "test", "cup/c": "train", "cup/d": "test"}
