"""The errors that a user is meant to read."""


class InputError(ValueError):
    """Something given to mmmgpu cannot be used.

    The message is one line that says what is wrong, where, and what to do; the command line prints
    it as it is and exits with status 1. It is never raised for a defect of mmmgpu itself.
    """


class DeviceError(InputError):
    """A device or its driver failed: it cannot build a kernel, or is no longer there."""


class DeviceMemoryError(DeviceError):
    """A device has not enough memory for what was asked of it. Less at a time may do."""
