"""The camera's own process: a thin remote control of libgphoto2, and the only module that imports gphoto2.

``python -m rigs.gphoto2_worker`` reads requests ``{"id", "op", ...}`` from standard input and answers each with
``{"id", "ok": value}`` or ``{"id", "error": {"code", "text", "log"}}`` on standard output (see
:mod:`rigs.gphoto2_wire`). It decides nothing: what to do about an error is decided on the other side, which can also
kill this process when a call hangs inside the library. It ends when its standard input closes, whatever it is doing,
so a killed workbench leaves no process behind that holds the camera.
"""

from __future__ import annotations

import base64
import hashlib
import os
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from rigs.gphoto2_wire import Message, Unpacker, pack

_LOG_LINES = 6
_SHORT_NAP_S = 0.02


class Library:
    """Answers requests with python-gphoto2; one camera at a time."""

    def __init__(self) -> None:
        import gphoto2

        self._gp: Any = gphoto2
        self._camera: Any = None
        self._log: deque[str] = deque(maxlen=_LOG_LINES)
        result = gphoto2.gp_log_add_func(gphoto2.GP_LOG_ERROR, self._remember, None)
        self._log_handle = gphoto2.check_result(result)  # the callback lives as long as this object

    def _remember(self, _level: int, _domain: str, text: str, _data: object = None) -> None:
        self._log.append(text.strip())

    def answer(self, request: Message) -> Message:
        """Carry out one request."""
        arguments = {name: value for name, value in request.items() if name not in ("id", "op")}
        operation: Callable[..., Any] | None = getattr(self, f"op_{request['op']}", None)
        if operation is None:
            return {"error": {"code": -2, "text": f"unknown operation {request['op']}", "log": []}}
        self._log.clear()
        try:
            return {"ok": operation(**arguments)}
        except self._gp.GPhoto2Error as error:
            return {"error": {"code": error.code, "text": error.string, "log": list(self._log)}}
        except OSError as error:
            return {"os_error": {"errno": error.errno, "text": error.strerror or str(error)}}

    def op_hello(self) -> dict[str, Any]:
        """Versions, and who answers."""
        gp = self._gp
        version = gp.gp_library_version(gp.GP_VERSION_SHORT)[0]
        return {"pid": os.getpid(), "library": str(version), "binding": str(gp.__version__)}

    def op_list(self) -> list[list[str]]:
        """Model and port of every camera that can be seen."""
        found = self._gp.Camera.autodetect()
        return [[found.get_name(i), found.get_value(i)] for i in range(found.count())]

    def op_open(self, model: str, port: str) -> None:
        """Open the camera of this model at this port."""
        gp = self._gp
        self.op_close()
        ports = gp.PortInfoList()
        ports.load()
        kinds = gp.CameraAbilitiesList()
        kinds.load()
        camera = gp.Camera()
        camera.set_port_info(ports[ports.lookup_path(port)])
        camera.set_abilities(kinds[kinds.lookup_model(model)])
        camera.init()
        self._camera = camera

    def op_close(self) -> None:
        """Let go of the camera."""
        camera, self._camera = self._camera, None
        if camera is not None:
            with suppress(self._gp.GPhoto2Error):
                camera.exit()

    def _opened(self) -> Any:
        if self._camera is None:
            raise self._gp.GPhoto2Error(self._gp.GP_ERROR_IO_USB_FIND)
        return self._camera

    def op_config(self) -> dict[str, Any]:
        """Every widget by name."""
        tree = self._opened().get_config()
        return {widget.get_name(): self._described(widget) for widget in self._leaves(tree)}

    def _leaves(self, widget: Any) -> Iterator[Any]:
        if widget.get_type() in (self._gp.GP_WIDGET_WINDOW, self._gp.GP_WIDGET_SECTION):
            for i in range(widget.count_children()):
                yield from self._leaves(widget.get_child(i))
        else:
            yield widget

    def _described(self, widget: Any) -> dict[str, Any]:
        kind = widget.get_type()
        choices: list[str] = []
        if kind in (self._gp.GP_WIDGET_RADIO, self._gp.GP_WIDGET_MENU):
            choices = [widget.get_choice(i) for i in range(widget.count_choices())]
        try:
            value = widget.get_value()
        except (self._gp.GPhoto2Error, ValueError):
            value = None  # one property that can't be read must not hide all others
        if not isinstance(value, str | int | float | None):
            value = str(value)
        return {"value": value, "choices": choices, "readonly": bool(widget.get_readonly())}

    def op_get(self, name: str) -> dict[str, Any]:
        """Read one widget from the camera."""
        return self._described(self._opened().get_single_config(name))

    def op_set(self, name: str, value: str | int | float) -> dict[str, Any]:
        """Set one widget and read it back from the camera."""
        self._put(self._opened(), name, value)
        return self.op_get(name)

    def op_trigger(self) -> None:
        """Release the shutter; files come as events."""
        self._opened().trigger_capture()

    def op_press(self, name: str, values: list[str]) -> None:
        """Press and let go of the shutter release by one widget's values in turn; files come as events."""
        camera = self._opened()
        press, *let_go = values
        try:
            self._put(camera, name, press)
        finally:  # a button that stays down keeps the camera busy
            for value in let_go:
                self._put(camera, name, value)

    def _put(self, camera: Any, name: str, value: str | int | float) -> None:
        widget = camera.get_single_config(name)
        widget.set_value(value)
        camera.set_single_config(name, widget)

    def op_capture(self) -> list[str]:
        """Release the shutter and wait for the first file (cameras that can't be triggered)."""
        path = self._opened().capture(self._gp.GP_CAPTURE_IMAGE)
        return [path.folder, path.name]

    def op_wait(self, timeout_s: float) -> Message:
        """One event, or none within the time."""
        gp = self._gp
        started = time.monotonic()
        kind, data = self._opened().wait_for_event(int(timeout_s * 1000))
        if kind == gp.GP_EVENT_FILE_ADDED:
            return {"event": "file", "folder": data.folder, "name": data.name}
        if kind == gp.GP_EVENT_CAPTURE_COMPLETE:
            return {"event": "complete"}
        if kind == gp.GP_EVENT_TIMEOUT:
            # Some drivers report a timeout at once: the caller's loop must not spin.
            time.sleep(max(0.0, min(timeout_s, _SHORT_NAP_S) - (time.monotonic() - started)))
            return {"event": "timeout"}
        return {"event": "other", "text": data if isinstance(data, str) else ""}

    def op_size(self, folder: str, name: str) -> int:
        """Size of a file as the camera states it, bytes; 0 where it doesn't."""
        info = self._opened().file_get_info(folder, name)
        return int(info.file.size) if info.file.fields & self._gp.GP_FILE_INFO_SIZE else 0

    def op_download(self, folder: str, name: str, path: str) -> dict[str, Any]:
        """Copy a file to ``path`` on our disk, synced."""
        gp = self._gp
        # The CameraFile owns the memory behind the view: it has to outlive it.
        camera_file = self._opened().file_get(folder, name, gp.GP_FILE_TYPE_NORMAL)
        data = memoryview(camera_file.get_data_and_size())
        with Path(path).open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        result = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        data.release()
        del camera_file
        return result

    def op_discard(self, folder: str, name: str) -> None:
        """Fetch a file from the camera's memory and forget it; the camera stays busy until it is fetched."""
        camera_file = self._opened().file_get(folder, name, self._gp.GP_FILE_TYPE_NORMAL)
        del camera_file
        with suppress(self._gp.GPhoto2Error):  # fetching alone removes it from some cameras' memory
            self.op_delete(folder, name)

    def op_delete(self, folder: str, name: str) -> None:
        """Delete a file in the camera."""
        self._opened().file_delete(folder, name)

    def op_preview(self) -> str:
        """One live-view picture, base64."""
        camera_file = self._opened().capture_preview()
        data = memoryview(camera_file.get_data_and_size())
        text = base64.b64encode(data).decode("ascii")
        data.release()
        del camera_file
        return text

    def op_storage(self) -> list[dict[str, Any]]:
        """Memory of the camera: free and total space (kB), free images; None where not stated."""
        gp = self._gp
        known = (
            ("free_kb", gp.GP_STORAGEINFO_FREESPACEKBYTES, "freekbytes"),
            ("total_kb", gp.GP_STORAGEINFO_MAXCAPACITY, "capacitykbytes"),
            ("free_images", gp.GP_STORAGEINFO_FREESPACEIMAGES, "freeimages"),
        )
        return [
            {key: int(getattr(store, name)) if store.fields & bit else None for key, bit, name in known}
            for store in self._opened().get_storageinfo()
        ]


def _requests(stream: int) -> Iterator[Message]:
    """Requests in order; the process ends with its standard input, even in the middle of a call."""
    waiting: queue.SimpleQueue[Message] = queue.SimpleQueue()

    def read() -> None:
        unpacker = Unpacker()
        while True:
            try:
                data = os.read(stream, 1 << 16)
                messages = unpacker.feed(data)
            except (OSError, ValueError):
                os._exit(1)
            if not data:
                os._exit(0)
            for message in messages:
                waiting.put(message)

    threading.Thread(target=read, daemon=True).start()
    while True:
        yield waiting.get()


def main() -> None:
    """Serve requests until standard input closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the workbench, which then closes the camera
    reply_stream = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever the library prints must not end up among the replies
    library: Library | None = None
    for request in _requests(0):
        try:
            library = library or Library()
            reply = library.answer(request)
        except ImportError as error:
            reply = {"error": {"code": 0, "text": str(error), "log": []}}
        except Exception as error:  # a bug here must reach the operator as such, not as a dead pipe
            reply = {"error": {"code": -1, "text": f"{type(error).__name__}: {error}", "log": []}}
        try:
            reply_stream.write(pack({"id": request.get("id"), **reply}))
            reply_stream.flush()
        except BrokenPipeError:
            os._exit(0)


if __name__ == "__main__":
    main()
