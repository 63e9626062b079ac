"""The errors that a user is meant to read, and the one warning."""

import warnings


class InputError(ValueError):
    """Something given to mmmgpu cannot be used.

    The message is one line that says what is wrong, where, and what to do; the command line prints
    it as it is and exits with status 1. It is never raised for a defect of mmmgpu itself.
    """


class DeviceError(InputError):
    """A device or its driver failed: it cannot build a kernel, or is no longer there."""


class DeviceMemoryError(DeviceError):
    """A device has not enough memory for what was asked of it. Less at a time may do."""


class UnsettledWarning(UserWarning):
    """A fit was ended by its cap on iterations, not by its own rule: it might get better."""


def say_warnings() -> None:
    """Print warnings to the standard error as one line each, as the command line does.

    Those of one text are said once.
    """

    def say(message: Warning | str, category: type[Warning], *_: object, **__: object) -> str:
        return f"warning: {message}\n"

    warnings.formatwarning = say
    warnings.simplefilter("once", UnsettledWarning)
