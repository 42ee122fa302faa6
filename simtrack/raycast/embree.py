"""The Embree 4 library that the `embreex` wheel carries, reached through its C interface.

`embreex` itself exposes single rays and no instances. The same library is loaded here a second time by its file name
(the loader hands out the same mapping), set up through ctypes, and its ray queries are registered as symbols that
compiled numba kernels call without the interpreter. Signatures and constants follow `embree4/rtcore.h` of Embree 4.4.
"""

import ctypes
import importlib.util
import os
import warnings
from functools import cache
from pathlib import Path

from simtrack.errors import RaycastError

RTC_GEOMETRY_TYPE_TRIANGLE = 0
RTC_GEOMETRY_TYPE_INSTANCE = 121
RTC_BUFFER_TYPE_INDEX = 0
RTC_BUFFER_TYPE_VERTEX = 1
RTC_FORMAT_UINT3 = 0x5003
RTC_FORMAT_FLOAT3 = 0x9003
RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR = 0x9234
RTC_BUILD_QUALITY_HIGH = 2
RTC_SCENE_FLAG_DYNAMIC = 1
RTC_DEVICE_PROPERTY_VERSION = 0
RTC_DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED = 34
RTC_MAX_TIME_STEP_COUNT = 129

ERROR_NAMES = (
    "RTC_ERROR_NONE",
    "RTC_ERROR_UNKNOWN",
    "RTC_ERROR_INVALID_ARGUMENT",
    "RTC_ERROR_INVALID_OPERATION",
    "RTC_ERROR_OUT_OF_MEMORY",
    "RTC_ERROR_UNSUPPORTED_CPU",
    "RTC_ERROR_CANCELLED",
)
"""Names of RTCError, by code."""

KERNEL_SYMBOLS = (
    *("rtcIntersect8", "rtcIntersect16", "rtcOccluded8", "rtcOccluded16", "rtcPointQuery"),
    *("rtcNewGeometry", "rtcSetGeometryInstancedScene", "rtcSetGeometryTimeStepCount", "rtcSetGeometryTransform"),
    *("rtcCommitGeometry", "rtcAttachGeometryByID", "rtcReleaseGeometry", "rtcDetachGeometry"),
)
"""What compiled kernels call by name."""

FALLBACK_VARIABLE = "SIMTRACK_RAYCAST"
"""Environment variable: ``fallback`` forces `EmbreeScene.run` instead of instances and packets."""
CONFIG_VARIABLE = "SIMTRACK_EMBREE_CONFIG"
"""Environment variable, read when the device is made: settings of Embree's `rtcNewDevice`, e.g. ``isa=avx2``."""

VERSIONS = (40_300, 50_000)
"""Versions of the library (10,000 major + 100 minor + patch) whose structures the kernels know: from 4.3, below 5."""

_POINTER, _UINT, _INT, _SIZE = ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_size_t
_SIGNATURES: dict[str, tuple[object, list[object]]] = {
    "rtcNewDevice": (_POINTER, [ctypes.c_char_p]),
    "rtcReleaseDevice": (None, [_POINTER]),
    "rtcGetDeviceError": (_INT, [_POINTER]),
    "rtcGetDeviceLastErrorMessage": (ctypes.c_char_p, [_POINTER]),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, [_POINTER, _INT]),
    "rtcNewScene": (_POINTER, [_POINTER]),
    "rtcReleaseScene": (None, [_POINTER]),
    "rtcSetSceneFlags": (None, [_POINTER, _INT]),
    "rtcSetSceneBuildQuality": (None, [_POINTER, _INT]),
    "rtcCommitScene": (None, [_POINTER]),
    "rtcNewGeometry": (_POINTER, [_POINTER, _INT]),
    "rtcReleaseGeometry": (None, [_POINTER]),
    "rtcCommitGeometry": (None, [_POINTER]),
    "rtcEnableGeometry": (None, [_POINTER]),
    "rtcDisableGeometry": (None, [_POINTER]),
    "rtcSetGeometryBuildQuality": (None, [_POINTER, _INT]),
    "rtcAttachGeometry": (_UINT, [_POINTER, _POINTER]),
    "rtcAttachGeometryByID": (None, [_POINTER, _POINTER, _UINT]),
    "rtcDetachGeometry": (None, [_POINTER, _UINT]),
    "rtcSetGeometryInstancedScene": (None, [_POINTER, _POINTER]),
    "rtcSetGeometryTimeStepCount": (None, [_POINTER, _UINT]),
    "rtcSetGeometryTransform": (None, [_POINTER, _UINT, _INT, _POINTER]),
    "rtcSetSharedGeometryBuffer": (None, [_POINTER, _INT, _UINT, _INT, _POINTER, _SIZE, _SIZE, _SIZE]),
}


class Embree:
    """One Embree device of the process and the functions that set scenes up."""

    def __init__(self, library: ctypes.CDLL) -> None:
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
        self.api = library
        # One build thread: meshes are built once, instances in microseconds, and the tree (so the winner among equally
        # near faces) cannot depend on the number of cores.
        settings = ",".join(filter(None, ("threads=1", os.environ.get(CONFIG_VARIABLE, ""))))
        self.device: int = library.rtcNewDevice(settings.encode()) or 0
        self.check(f"rtcNewDevice({settings!r})")
        version = self.property(RTC_DEVICE_PROPERTY_VERSION)
        self.version: str = f"{version // 10_000}.{version // 100 % 100}.{version % 100}"
        """Of the library."""
        if not VERSIONS[0] <= version < VERSIONS[1]:
            raise RaycastError(
                f"Embree: the library of the embreex wheel is version {self.version}; needed is 4.3 or later, below 5,"
                " as in the wheels of embreex 4.4"
            )
        self.packet_width: int = 16 if self.property(RTC_DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED) else 8
        """Rays in a packet: 16 where the device calls that native (AVX-512, if settings do not forbid it), else 8."""

    def property(self, number: int) -> int:
        """A property of the device, by its RTCDeviceProperty."""
        return int(self.api.rtcGetDeviceProperty(self.device, number))

    def check(self, call: str) -> None:
        """Raise RaycastError with the name of the device's pending error, if there is one."""
        code = self.api.rtcGetDeviceError(self.device or None)
        if code or not self.device:
            name = ERROR_NAMES[code] if 0 <= code < len(ERROR_NAMES) else f"RTCError {code}"
            message = (self.api.rtcGetDeviceLastErrorMessage(self.device or None) or b"").decode(errors="replace")
            raise RaycastError(f"Embree: {call} failed with {name}{': ' + message if message else ''}")


def fallback_forced() -> bool:
    """Whether the environment asks for the fallback (see `FALLBACK_VARIABLE`)."""
    return os.environ.get(FALLBACK_VARIABLE, "").lower() == "fallback"


def _library_files() -> tuple[Path, Path]:
    """Paths of TBB and Embree inside the embreex wheel."""
    spec = importlib.util.find_spec("embreex")
    if spec is None or spec.origin is None:
        raise RaycastError("Embree: the package 'embreex' is not installed; install it with `pip install embreex`")
    folder = Path(spec.origin).parents[1] / "embreex.libs"
    found = [sorted(folder.glob(pattern)) for pattern in ("libtbb*", "libembree4*")]
    if not all(found):
        raise RaycastError(f"Embree: no libtbb* and libembree4* in {folder}; the wheels of embreex >= 4.4 carry them")
    return found[0][0], found[1][0]


@cache
def embree() -> Embree:
    """The process-wide device, loaded at the first call.

    Raises:
        RaycastError: the library is missing, is not Embree 4 or refuses this CPU.
    """
    from llvmlite import binding

    try:
        tbb, library_file = _library_files()
        ctypes.CDLL(str(tbb), mode=ctypes.RTLD_GLOBAL)
        library = ctypes.CDLL(str(library_file))
        # A compiled kernel from numba's cache that met an unregistered symbol would crash, so registering comes first.
        for name in KERNEL_SYMBOLS:
            binding.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)
        return Embree(library)
    except (OSError, AttributeError) as error:
        raise RaycastError(f"Embree: cannot use the library of the embreex wheel: {error}") from error


@cache
def available() -> bool:
    """Whether instances and packets can be used; otherwise rays go through `EmbreeScene.run`, and a warning says why.

    Raises:
        RaycastError: the settings in the environment are refused; without them the device might work.
    """
    try:
        embree()
    except RaycastError as error:
        if os.environ.get(CONFIG_VARIABLE):
            raise
        warnings.warn(f"{error}; rays are cast one by one, which is slower", RuntimeWarning, stacklevel=2)
        return False
    return True
