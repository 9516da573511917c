"""A synthetic scene as a capture, rendered when a frame is read: nothing lies on disk."""

from dataclasses import dataclass, replace

from extrap_train.config import SyntheticConfig
from extrap_train.data.sequences import Frame, Sequence
from extrap_train.data.synthetic.build import build_scene
from extrap_train.data.synthetic.orbit import handheld_orbit, sequence_name, walk_seed
from extrap_train.data.synthetic.render import render
from extrap_train.data.synthetic.scene import SyntheticScene
from extrap_train.views import Camera, View


@dataclass(frozen=True)
class _Renderer:
    scene: SyntheticScene
    camera: Camera
    name: str

    def load(self, *, depth: bool = True) -> View:
        view = replace(render(self.scene, self.camera), name=self.name)
        return view if depth else replace(view, depth=None)


def synthetic_sequence(category: str, index: int, options: SyntheticConfig) -> Sequence:
    """The walk around a scene that `data=synthetic` trains on or tests with, not yet rendered.

    Sequences 0 … `test_sequences` − 1 are for testing. Pictures are those on disk before their
    compression. Raises InputError for an unknown category.
    """
    scene = build_scene(category, index, options.seed)
    seed = walk_seed(category, index, options.seed)
    cameras = handheld_orbit(scene, options.frames, options.image_size, seed)
    frames = []
    for number in range(options.frames):
        name, camera = f"frame{number:06d}", cameras[number]
        frames.append(Frame(name, camera, True, True, _Renderer(scene, camera, name).load, ()))
    return Sequence(category, sequence_name(index), tuple(frames))
