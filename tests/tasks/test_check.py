"""`task=check` on a folder with camera files."""

from captures import view_at
from in_process import refused_command, run_command
from PIL import Image
from posed_folders import write_transforms

from extrap_train.__main__ import main


def test_a_check_draws_its_picture_each_time(tmp_path):
    write_transforms(tmp_path / "garden", [view_at(10 * k) for k in range(3)])
    command = ["task=check", f"scene={tmp_path}/garden", f"output={tmp_path}/out"]
    said = run_command(main, *command)
    picture = tmp_path / "out" / "check" / "garden" / "check.png"
    assert said.endswith(f"result: {picture}\n")
    assert f"poses: {tmp_path}/garden/transforms.json\n" in said
    assert "overlap" in said  # 32 pixels have no features
    Image.open(picture).verify()
    assert run_command(main, *command, "seed=1") == said


def test_a_check_takes_three_views(tmp_path):
    write_transforms(tmp_path / "garden", [view_at(0), view_at(30)])
    refused_command(["task=check", "category=cup", f"scene={tmp_path}/garden"], tmp_path)
    assert not (tmp_path / "out").exists()
