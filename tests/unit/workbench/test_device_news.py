from pathlib import Path

from rigs.gphoto2_config import CameraEvent
from rigs.gphoto2_faults import Fault, Remedy
from workbench.device_news import DeviceNews
from workbench.journal import Journal


def test_events_reach_the_operator_at_once_and_the_journal_while_there_is_one(tmp_path: Path) -> None:
    told: list[str] = []
    news = DeviceNews(told.append)
    news(CameraEvent("camera: battery at 10%"))
    assert told == ["camera: battery at 10%"]
    journal = Journal(tmp_path / "journal.jsonl")
    with news.journaled(journal):
        news(CameraEvent("camera: busy; waiting", Fault.BUSY, Remedy.DRAIN, 2))
    news(CameraEvent("camera: afterwards"))
    journal.close()
    first, second = Journal(journal.path).records
    assert first["message"] == "camera: battery at 10%"
    assert "fault" not in first
    assert (second["type"], second["fault"], second["remedy"], second["attempt"]) == (
        "event", "busy", "emptying its event queue, waiting, trying again", 2,
    )  # fmt: skip
    assert told[1:] == ["camera: busy; waiting", "camera: afterwards"]
