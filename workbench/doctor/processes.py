"""Running programs that are known to grab cameras and serial ports; read from /proc, empty where there is none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

_MOUNTS = ("gvfsd-gphoto2", "gvfs-gphoto2-volume-monitor")
_CAMERA_PROGRAMS = ("gphoto2", "entangle", "darktable", "digikam", "shotwell", "rawtherapee", "kamera")

_SERIAL_PROGRAMS = (
    ("brltty", "it takes adapters with a CH340 chip for braille displays", "uninstall brltty, plug the stage in again"),
    ("ModemManager", "it talks to a new serial port as if it were a modem", "wait half a minute after plugging in"),
)
"""Each with what it does and the way out."""


def running(proc: Path = Path("/proc")) -> tuple[str, ...]:
    """Names of the programs that run here, sorted, each once."""
    names = set()
    for path in proc.glob("[0-9]*/cmdline"):
        try:
            command = path.read_bytes().split(b"\0")[0]
        except OSError:  # it has ended meanwhile, or is not ours to see
            continue
        names.add(Path(command.decode(errors="replace")).name)
    return tuple(sorted(names - {""}))


def desktop_mounts(programs: Sequence[str]) -> list[str]:
    """Programs by which a desktop mounts cameras as folders; the one that holds a camera first."""
    return [name for name in _MOUNTS if name in programs]


def camera_programs(programs: Sequence[str]) -> list[str]:
    """Programs with which people look at their cameras."""
    return [name for name in _CAMERA_PROGRAMS if name in programs]


def serial_programs(programs: Sequence[str]) -> list[tuple[str, str, str]]:
    """Programs that take serial ports: name, what they do, the way out."""
    return [entry for entry in _SERIAL_PROGRAMS if entry[0] in programs]
