"""What a user reads when a device or its driver fails: the same for all backends."""

from mmmgpu.errors import DeviceError, DeviceMemoryError


def out_of_memory(device: str, error: Exception) -> DeviceMemoryError:
    """`device`, a name for `get_backend`, has not enough memory."""
    return DeviceMemoryError(
        f"{device}: not enough memory ({_said(error)}); give smaller pictures, or choose another "
        "device with --backend"
    )


def out_of_resources(device: str, error: Exception) -> DeviceMemoryError:
    """`device` has not enough memory, or has failed: its driver says the same of both."""
    return DeviceMemoryError(
        f"{device}: not enough memory, or the device failed ({_said(error)}); give smaller "
        "pictures, run the same again, or choose another device with --backend"
    )


def device_failed(device: str, error: Exception) -> DeviceError:
    """`device`, a name for `get_backend`, has failed or is no longer there."""
    return DeviceError(
        f"{device}: the device failed ({_said(error)}); if it is still there, run the same again, "
        "else choose another with --backend"
    )


def not_built(device: str, source: str, error: Exception | str) -> DeviceError:
    """What compiles for `device`, or loads what is compiled, has failed at the file `source`."""
    return DeviceError(
        f"{device}: cannot build {source} ({_said(error)}); choose another device with --backend: "
        "mmmgpu info lists those present"
    )


def _said(error: Exception | str) -> str:
    """The driver's own words, in one line."""
    return " ".join(str(error).split())
