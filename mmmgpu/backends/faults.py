"""What a user reads when a device or its driver fails: the same for all backends."""

from mmmgpu.errors import DeviceError, DeviceMemoryError


def out_of_memory(device: str, error: Exception) -> DeviceMemoryError:
    """`device`, a name for `get_backend`, has not enough memory."""
    return DeviceMemoryError(
        f"{device}: not enough memory ({_said(error)}); give smaller pictures, or choose another "
        "device with --backend"
    )


def device_failed(device: str, error: Exception) -> DeviceError:
    """`device`, a name for `get_backend`, has failed or is no longer there."""
    return DeviceError(
        f"{device}: the device failed ({_said(error)}); if it is still there, run the same again, "
        "else choose another with --backend"
    )


def _said(error: Exception) -> str:
    """The driver's own words, in one line."""
    return " ".join(str(error).split())
