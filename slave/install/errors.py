"""What goes wrong while a slave is installed."""


class InstallError(Exception):
    """The installation is not possible.

    The text is one line that states why, and what to do. The machine is as it was before.
    """


class NotReadyError(InstallError):
    """What was installed does not run."""
