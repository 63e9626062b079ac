"""The one error that a user is meant to read."""


class InputError(ValueError):
    """Something given to mmmgpu cannot be used.

    The message is one line that says what is wrong, where, and what to do; the command line prints
    it as it is and exits with status 1. It is never raised for a defect of mmmgpu itself.
    """
