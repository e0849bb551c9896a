"""What goes wrong with hardware, as one tree; foreign exceptions are mapped to it once, at the driver.

Every message is one line that names the device or key and says the way out.
"""

from __future__ import annotations


class RigError(Exception):
    """A device is in trouble. The message is for the operator: what, where, and what to do next."""


class ConfigError(RigError):
    """The configuration of a device is wrong (bad input rather than device trouble)."""


class DeviceNotFoundError(RigError):
    """The configured device isn't there."""


class DeviceBusyError(RigError):
    """The device is held by something else, or doesn't come free."""


class ConnectionLostError(RigError):
    """The device was there and is gone: unplugged, powered off, out of reach."""


class ProtocolError(RigError):
    """The device answered something that its protocol doesn't allow (garbage, torn, wrong echo)."""


class DeviceTimeoutError(RigError):
    """The device didn't answer or finish in the time that the operation can take."""


class StageError(RigError):
    """The stage refuses or fails."""


class AlarmError(StageError):
    """The stage's controller is in alarm."""


class NotHomedError(StageError):
    """The stage doesn't know where it is."""


class LimitError(StageError):
    """The requested position lies outside the stage's travel."""


class PositionLostError(NotHomedError):
    """The stage knew its position and has lost it."""


class StoppedError(StageError):
    """A movement was stopped before its end, by us or by a button on the machine."""


class CameraError(RigError):
    """The camera refuses or fails."""


class SettingError(CameraError):
    """A camera setting is not offered, or what was read back is not what was set."""


class CaptureError(CameraError):
    """No usable frame arrived."""


class PanelError(RigError):
    """The panel refuses or fails."""


class NotAcknowledgedError(PanelError):
    """The panel didn't confirm in time that it painted the pattern."""
