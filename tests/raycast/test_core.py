"""What a user of threads, long runs, other libraries and other machines relies on."""

import ctypes
import gc
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
import trimesh

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import RaycastError
from simtrack.geometry.transforms import exp_so3, look_at, transform
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.raycast import embree as rtc

REPOSITORY = Path(__file__).resolve().parents[2]
CAMERA = CameraIntrinsics(160, 120, 110.0, 110.0, 79.5, 59.5)
BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
ROOM = trimesh.creation.box((8.0, 6.0, 3.0)).subdivide().subdivide()


def shape(mesh: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces)


def furnished(seed: int = 0) -> RayScene:
    """A room with ten balls, not committed."""
    rng = np.random.default_rng(seed)
    scene, ball = RayScene(), shape(BALL)
    scene.add(shape(ROOM))
    for _ in range(10):
        scene.add(ball, transform(exp_so3(rng.normal(size=3)), rng.uniform((-3, -2, -1), (3, 2, 1))))
    return scene


def answers(scene: RayScene, k: int) -> bytes:
    """All that a scene answers to questions that depend on k, as bytes."""
    rng = np.random.default_rng(k)
    origins, directions = rng.uniform(-1, 1, (2, 5000, 3))
    hits = scene.cast(RayBundle.from_camera(CAMERA), look_at(origins[0], directions[0] + [0.0, 0.0, 2.0]))
    rays = scene.cast_rays(origins, directions)
    near = scene.closest_points(origins[:300], signed=True)
    blocked = scene.occluded(origins, directions, np.ones(5000))
    parts = hits.distances, hits.normals, hits.faces, rays.instances, rays.normals, near.points, near.distances, blocked
    return b"".join(part.tobytes() for part in parts)


def in_threads(count: int, work: "list[tuple[RayScene, int]]") -> list[bytes]:
    """The answers to `work`, dealt to threads."""
    out: list[bytes] = [b""] * len(work)

    def run(first: int) -> None:
        for k in range(first, len(work), count):
            out[k] = answers(*work[k])

    workers = [threading.Thread(target=run, args=(first,)) for first in range(count)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    return out


def test_threads_ask_one_scene_and_many_and_get_what_one_thread_gets() -> None:
    questions = range(8)
    with furnished(0) as scene, furnished(0) as same, furnished(1) as other:
        expected = [answers(scene, k) for k in questions]
        # `same` and `other` are not committed yet: several threads meet at that.
        work = [(one, k) for k in questions for one in (same, other, scene)]
        got = in_threads(6, work)
        for one, name in ((same, 0), (scene, 2)):
            assert got[name::3] == expected, f"scene {name} differs"
            assert [answers(one, k) for k in questions] == expected
        assert got[1::3] == [answers(other, k) for k in questions]
        before = numba.get_num_threads()
        try:
            numba.set_num_threads(1)
            assert [answers(scene, k) for k in questions] == expected
        finally:
            numba.set_num_threads(before)


@pytest.fixture
def device_memory() -> Iterator["list[int]"]:
    """Total of the bytes that Embree holds, kept up to date."""
    total = [0]
    callback_type = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_bool)

    def count(_: int, size: int, __: bool) -> bool:
        total[0] += size
        return True

    callback = callback_type(count)
    watch = rtc.embree().api.rtcSetDeviceMemoryMonitorFunction
    watch.restype, watch.argtypes = None, [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    gc.collect()
    watch(rtc.embree().device, ctypes.cast(callback, ctypes.c_void_p), None)
    yield total
    watch(rtc.embree().device, None, None)


def test_embrees_memory_goes_with_its_owners(device_memory: "list[int]") -> None:
    def live() -> int:
        gc.collect()
        return device_memory[0]

    assert live() == 0
    scene, ball, room = RayScene(), shape(BALL), shape(ROOM)
    scene.add(room)
    for k in range(5):
        scene.add(ball, transform(translation=(k, 0.0, 0.0)))
    answers(scene, 0)
    full = live()
    assert full > 0
    for k in range(20):  # the ground changes, instances come and go
        scene.set_pose(0, transform(translation=(0.0, 0.0, 0.1 * (k % 2))))
        scene.remove(1 + k % 5)
        scene.add(ball, transform(translation=(k, 0.0, 0.0)), instance=1 + k % 5)
        scene.set_enabled(2, bool(k % 3))
        answers(scene, 0)
    assert live() <= 1.1 * full
    scene.close()
    only_meshes = live()
    assert 0 < only_meshes < full
    del ball
    assert 0 < live() < only_meshes
    del room
    assert live() == 0
    dropped = furnished()
    answers(dropped, 0)
    assert live() > 0
    del dropped  # without being closed
    assert live() == 0


def test_memory_of_the_process_stays_flat_over_many_scenes() -> None:
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def cycle() -> None:
        with furnished() as scene:
            answers(scene, 0)

    for _ in range(10):
        cycle()
    before = resident()
    for _ in range(60):
        cycle()
    assert resident() - before < 8_000_000


class Library:
    """Embree as far as its constructor asks, of another version."""

    def __init__(self, library: ctypes.CDLL, version: int) -> None:
        self._library, self._version = library, version

    def __getattr__(self, name: str) -> object:
        if name == "rtcGetDeviceProperty":
            return self.version
        return getattr(self._library, name)

    @property
    def version(self) -> object:
        def answer(device: int, number: int) -> int:
            return self._version

        return answer


@pytest.mark.parametrize("version", [31_300, 40_200, 50_000])
def test_another_version_of_the_library_is_refused(version: int) -> None:
    library: object = Library(rtc.embree().api, version)
    with pytest.raises(RaycastError, match=rf"version {version // 10_000}\.{version // 100 % 100}\.0.*4\.3 or later"):
        rtc.Embree(library)  # pyright: ignore[reportArgumentType]


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "always", "-c", code],
        env=os.environ | environment,
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )


MISSING = """
from simtrack.raycast import embree as rtc
def missing():
    raise rtc.RaycastError("Embree: not here")
rtc._library_files = missing
from simtrack.raycast import RayScene
"""


def test_settings_of_the_device_come_from_the_environment() -> None:
    code = "from simtrack.raycast.embree import embree; print(embree().packet_width)"
    assert run_python(code, **{rtc.CONFIG_VARIABLE: "isa=avx2"}).stdout.strip() == "8"
    # Who asks for a device of a kind does not want to be served without one.
    refused = run_python(MISSING + "RayScene()", **{rtc.CONFIG_VARIABLE: "isa=avx2"})
    assert refused.returncode != 0 and "RaycastError: Embree: not here" in refused.stderr


def test_without_the_library_rays_are_cast_one_by_one_and_a_warning_says_why() -> None:
    done = run_python(MISSING + "print(RayScene().fallback, RayScene().fallback); RayScene(use_fallback=False)")
    assert done.stdout.strip() == "True True"
    assert done.stderr.count("RuntimeWarning: Embree: not here; rays are cast one by one") == 1
    assert done.returncode != 0 and "RaycastError: Embree: not here" in done.stderr


def test_the_laws_hold_in_the_fallback_too() -> None:
    """Ray casting's own tests, with `embreex`'s single rays in all scenes that do not ask for something else."""
    tests = "tests/raycast/test_scene.py", "tests/raycast/test_ground.py"
    of_embree = "leak or threads or errors or widths or environment or culling or queries_equal"
    command = [sys.executable, "-m", "pytest", *tests, "-k", f"not ({of_embree})", "-p", "no:cacheprovider"]
    environment = os.environ | {rtc.FALLBACK_VARIABLE: "fallback"}
    done = subprocess.run(command, env=environment, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]
    assert "passed" in done.stdout
