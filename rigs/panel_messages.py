"""What the panel's page says to the workbench, checked word by word."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

WakeLock = Literal["lock", "video", "none"]


class PageState(BaseModel):
    """The page's report of itself; part of every message."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    width_px: int = Field(ge=1, le=65536)
    """Device pixels across the canvas."""
    height_px: int = Field(ge=1, le=65536)
    device_pixel_ratio: float = Field(gt=0, le=100)
    fullscreen: bool
    visible: bool
    zoom: float = Field(gt=0)
    """Pinch zoom; anything but 1 smears device pixels."""
    wake_lock: WakeLock
    """``lock``: the browser keeps the screen on; ``video``: a playing video should; ``none``: nothing does."""


class StateMessage(BaseModel):
    """Sent on connecting, on every change, and in answer to every beat."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    type: Literal["state"]
    state: PageState


class PaintedMessage(BaseModel):
    """Sent two animation frames after a pattern was drawn."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    type: Literal["painted"]
    sequence: int
    state: PageState


class FailedMessage(BaseModel):
    """Sent when a pattern can't be drawn."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    type: Literal["failed"]
    sequence: int
    reason: str = Field(max_length=300)
    state: PageState


PageMessage = StateMessage | PaintedMessage | FailedMessage
_ADAPTER: TypeAdapter[PageMessage] = TypeAdapter(Annotated[PageMessage, Field(discriminator="type")])


def parse(text: str) -> PageMessage | None:
    """A message of the page; None where it is none."""
    try:
        return _ADAPTER.validate_json(text)
    except ValidationError:
        return None
