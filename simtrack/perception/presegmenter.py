"""Pre-segmentation beside the frames: images and scans in one thread, in a believed scene of its own.

A piece of work takes along what was believed when it was begun (poses, tracks, joints), so that the frames go on. Its
answer carries the stamp of the image or scan that it is about.
"""

from collections.abc import Mapping, Sequence

from simtrack.contracts import Bool, Float64, JointEstimate, LidarScan, Presegmentation, RgbdFrame, Track
from simtrack.perception.believed_scene import BelievedScene
from simtrack.perception.beside import Beside, worker
from simtrack.perception.self_filter import SelfFilter
from simtrack.perception.tracking.presegmentation import (
    PresegmentationConfig,
    presegment_camera,
    presegment_lidar,
)


class Presegmenter:
    """Segments one image and one scan at a time; owns the thread and the scenes that it does it in."""

    def __init__(
        self,
        believed: BelievedScene,
        body: SelfFilter,
        config: PresegmentationConfig,
        image_time: float,
        scan_time: float,
        wait: bool = True,
    ) -> None:
        """Start idle.

        Args:
            believed: nobody else's from now on.
            body: likewise.
            config: settings.
            image_time: an image's answer is taken up so many seconds of the sensor's clock after it was begun.
            scan_time: likewise.
            wait: see `simtrack.perception.beside`.
        """
        self._believed, self._body, self._config = believed, body, config
        self._thread = worker("presegmentation", wait)
        self.image = Beside[Presegmentation](self._thread, image_time, wait)
        self.scan = Beside[Presegmentation](self._thread, scan_time, wait)

    def begin_image(
        self,
        frame: RgbdFrame,
        T_map_camera: Float64,
        tracks: Sequence[Track],
        positions: Mapping[str, float],
        joints: Sequence[JointEstimate] = (),
    ) -> None:
        """Begin with a depth image, as believed at its stamp.

        Args:
            frame: the image.
            T_map_camera: (4, 4).
            tracks: what stands before the map.
            positions: joint name of the robot -> rad or m.
            joints: how far the map's doors and drawers are open.
        """

        def work() -> Presegmentation:
            self._believed.update(tracks, joints)
            own = self._body.camera_mask(frame, positions)
            return presegment_camera(frame, T_map_camera, self._believed.scene, own, self._config)

        self.image.begin(frame.stamp, work)

    def begin_scan(
        self,
        stamp: int,
        scan: LidarScan,
        poses: Mapping[int, Float64],
        tracks: Sequence[Track],
        own: Bool,
        joints: Sequence[JointEstimate] = (),
    ) -> None:
        """Begin with a scan at `stamp`, nanoseconds.

        Args:
            stamp: now.
            scan: one turn.
            poses: (4, 4) T_map_base at the stamps of `presegmentation.shot_stamps`.
            tracks: what stands before the map.
            own: (N,), True where the robot sees itself.
            joints: how far the map's doors and drawers are open.
        """

        def work() -> Presegmentation:
            self._believed.update(tracks, joints)
            return presegment_lidar(scan, poses.__getitem__, self._believed.scene, own, self._config)

        self.scan.begin(stamp, work)

    def close(self) -> None:
        """End the thread, when it is done, and release the scenes' memory."""
        self.image.drop()
        self.scan.drop()
        self._thread.shutdown()
        self._believed.close()
