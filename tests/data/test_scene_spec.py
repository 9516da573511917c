import pytest
from captures import view_at, write_capture
from complaints import complaint_of
from posed_folders import write_transforms
from test_colmap_model import Entry, write_binary

from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError


def test_a_co3d_sequence(tmp_path):
    write_capture(tmp_path)
    sequence = open_scene(f"co3d:{tmp_path}/cup/two")
    assert (sequence.category, sequence.name) == ("cup", "two")


def test_a_folder_with_transforms(tmp_path):
    write_transforms(tmp_path / "garden", [view_at(0), view_at(30)])
    assert open_scene(str(tmp_path / "garden")).name == "garden"


@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
def test_a_colmap_model(tmp_path, place):
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").touch()
    write_binary(tmp_path / place, [Entry("a.png", view_at(0).camera)])
    assert len(open_scene(str(tmp_path)).frames) == 1
    assert len(open_scene(str(tmp_path / place)).frames) == 1


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("synthetc:hydrant/0003", "no such file or folder; give co3d:ROOT/category/sequence"),
        ("{folder}/gone", "no such file or folder"),
        ("{folder}", "no camera file and no photographs"),
        ("co3d:cup/one", "is not co3d:ROOT/category/sequence"),
        ("co3d:{folder}/cup/one", "has no category 'cup'"),
    ],
)
def test_what_is_no_scene(tmp_path, spec, expected):
    with pytest.raises(InputError) as caught:
        open_scene(spec.format(folder=tmp_path))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["transforms.json", "cameras.xml", "1.jpg"])
def test_a_file_of_a_capture_is_told_to_be_its_folder(tmp_path, name):
    (tmp_path / name).write_text("{}")
    assert str(tmp_path) in complaint_of(open_scene, str(tmp_path / name)).partition(";")[2]


def test_a_model_without_pictures(tmp_path):
    write_binary(tmp_path, [Entry("a.png", view_at(0).camera)])
    with pytest.raises(InputError, match="no folder `images` beside it"):
        open_scene(str(tmp_path))
