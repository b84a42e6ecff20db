"""What goes wrong while a slave is installed."""


class InstallError(Exception):
    """It cannot be installed; the text is one line that says why, and what to do. The machine is as it was before."""


class NotReadyError(InstallError):
    """What was installed does not run."""
