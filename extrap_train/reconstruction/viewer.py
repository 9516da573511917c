"""The growing cloud in a browser (viser, the extra `viewer`)."""

import math
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import roma
from jaxtyping import Float

from extrap_train.data.image_files import to_eight_bits
from extrap_train.errors import InputError
from extrap_train.reconstruction.cloud import PointCloud, cloud_of
from extrap_train.reconstruction.global_map import GIVEN, GlobalMap, MapView
from extrap_train.views import Camera

if TYPE_CHECKING:
    from extrap_train.reconstruction.viewer_pages import Routes

GIVEN_COLOUR = (40, 110, 220)
GENERATED_COLOUR = (235, 130, 30)
OTHER_COLOUR = (150, 150, 150)
POINT_SIZE = 0.004
"""In units of the cameras' distance from the scene."""
FIRST_DISTANCE, FIRST_HEIGHT = 1.9, 0.7
"""Where a visitor first stands behind the first camera and above it, in that one's distance."""
FRUSTUM_SCALE, FRUSTUM_LINE = 0.08, 0.002


class CloudViewer:
    """A page with the cloud, the cameras, a slider over the steps and a least confidence.

    Given views have blue frusta, generated ones orange, other cameras grey. `show` may be called
    again and again; the page follows the newest step unless its visitor has gone back to an
    earlier one. Only this machine reaches it unless `host` says otherwise, and no other web page
    may talk to it.
    """

    def __init__(
        self,
        port: int,
        votes: bool = True,
        host: str = "127.0.0.1",
        *,
        option: str = "complete.host",
        routes: "Routes | None" = None,
    ) -> None:
        try:
            from extrap_train.reconstruction import viewer_pages
        except ImportError:
            raise InputError(
                f"{option.partition('.')[0]}: the page needs viser: pip install "
                '"extrap-train[viewer]"'
            ) from None
        self._votes = votes
        self._page = threading.RLock()  # sliders call from the server's threads
        self._cloud: PointCloud | None = None
        self._known: GlobalMap | None = None
        self._frusta: dict[int, Any] = {}
        self._others: list[Any] = []
        self.server = viewer_pages.open_server(option, host, port, routes or viewer_pages.Routes())
        self._host = host
        gui: Any = self.server.gui  # its typing makes values read-only
        gui.configure_theme(show_share_button=False)  # it would open a tunnel to a public server
        self._step = gui.add_slider("views", min=1, max=2, step=1, initial_value=1)
        self._least = gui.add_slider("least confidence", 0.0, 1.0, 0.05, 0.1)
        self._count = gui.add_text("points", "0", disabled=True)
        self._step.on_update(self._on_slider_moved)
        self._least.on_update(self._on_slider_moved)

    @property
    def port(self) -> int:
        """Where the page is: the wanted port, or the next free one."""
        return int(self.server.get_port())

    @property
    def url(self) -> str:
        """The page's address as a browser on this machine takes it."""
        everywhere = self._host in ("127.0.0.1", "0.0.0.0", "::", "::1", "")
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{'localhost' if everywhere else host}:{self.port}"

    @property
    def shown_points(self) -> int:
        """Points on the page."""
        return int(self._count.value)

    def select(self, views: int, least_confidence: float) -> None:
        """What the sliders do."""
        with self._page:
            self._step.value, self._least.value = views, least_confidence
            self._draw()

    def show(self, known: GlobalMap) -> None:
        """Put a map on the page."""
        cloud = cloud_of(known, votes=self._votes)
        with self._page:
            following = self._known is None or self._step.value == len(self._known)
            if self._known is None:
                self._face_scene(known)
            for index, view in enumerate(known.views):
                self._add_frustum(index, view)
            self._known, self._cloud = known, cloud
            self._step.max = max(2, len(known))
            if following:
                self._step.value = len(known)
            self._draw()

    def add_camera(self, name: str, camera: Camera) -> None:
        """Put a camera that is not one of the map's views on the page, without a picture."""
        with self._page:
            self._others.append(self._frustum(f"other/{name}", camera, OTHER_COLOUR))

    def clear(self) -> None:
        """Take the map and all cameras off the page."""
        with self._page:
            for frustum in (*self._frusta.values(), *self._others):
                frustum.remove()
            self._frusta, self._others = {}, []
            self._known = self._cloud = None
            self.server.scene.remove_by_name("/cloud")

    def close(self) -> None:
        """Take the page down."""
        self.server.stop()

    def __enter__(self) -> "CloudViewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _face_scene(self, known: GlobalMap) -> None:
        """Visitors first look over the first photographer's shoulder, with the same lens."""
        cam_to_world = known.cameras.cam_to_world.double().numpy()
        up = -cam_to_world[:, :3, 1].mean(0)
        first_position = cam_to_world[0, :3, 3]
        behind = FIRST_DISTANCE * first_position
        behind = behind + FIRST_HEIGHT * np.linalg.norm(first_position) * up
        scene: Any = self.server.scene
        scene.set_up_direction(up)
        visitors = [client.camera for client in self.server.get_clients().values()]
        first: Any = self.server.initial_camera
        first.up = up
        for camera in (first, *visitors):
            camera.position = behind
            camera.look_at = np.zeros(3)  # the map's world has the scene at its origin
            camera.fov = _height_of_view(known.views[0].camera)
        for camera in visitors:
            camera.up_direction = up

    def _on_slider_moved(self, event: Any) -> None:
        """A visitor moved a slider; where we did, `client_id` is None and we draw ourselves."""
        if event.client_id is not None:
            with self._page:
                self._draw()

    def _draw(self) -> None:
        if self._cloud is None or self._known is None:
            return
        views = int(self._step.value)
        kept = (self._cloud.view < views) & (self._cloud.confidence >= self._least.value)
        cloud = self._cloud[kept]
        self.server.scene.add_point_cloud(
            "/cloud", cloud.points.numpy(), to_eight_bits(cloud.colors), point_size=POINT_SIZE
        )
        self._count.value = str(len(cloud))
        for index in range(len(self._known)):
            self._frusta[index].visible = index < views

    def _add_frustum(self, index: int, view: MapView) -> None:
        if index in self._frusta:
            return
        given = view.origin.kind == GIVEN
        name = f"{'given' if given else 'generated'}/{view.view.name}"
        colour = GIVEN_COLOUR if given else GENERATED_COLOUR
        picture = to_eight_bits(view.view.image).transpose(1, 2, 0)
        self._frusta[index] = self._frustum(name, view.camera, colour, image=picture)

    def _frustum(
        self, name: str, camera: Camera, colour: tuple[int, int, int], **options: Any
    ) -> Any:
        pose: Float[np.ndarray, "4 4"] = camera.cam_to_world.double().numpy()
        quaternion = roma.quat_xyzw_to_wxyz(
            roma.rotmat_to_unitquat(camera.cam_to_world[:3, :3].double())
        )
        return self.server.scene.add_camera_frustum(
            f"/cameras/{name}",
            fov=_height_of_view(camera),
            aspect=camera.width / camera.height,
            scale=FRUSTUM_SCALE,
            thickness=FRUSTUM_LINE,
            color=colour,
            wxyz=quaternion.numpy(),
            position=pose[:3, 3],
            **options,
        )


def _height_of_view(camera: Camera) -> float:
    """A camera's vertical angle of view in radians."""
    return 2 * math.atan(camera.height / 2 / float(camera.intrinsics[1, 1]))
