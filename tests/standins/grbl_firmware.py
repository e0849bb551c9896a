"""GRBL 1.1h for one axis, told by recordings of the real firmware and by its source, in whatever time it is given.

The main loop is a generator, resumed by :meth:`GrblFirmware.step`; real-time bytes are taken out of the stream before
it, as the interrupt does. An abort unwinds the main loop without cutting short what it is in: a line that was
interrupted still earns its ``ok``, before the banner.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator

from tests.standins.grbl_gcode import Modes, RefusedError, Words, clean, read_words, target_mm
from tests.standins.rail import Braking, Motion, Rail, Trapezoid

Wait = Generator[None, None, None]

DEFAULTS = {
    0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0, 20: 1, 21: 1, 22: 1, 23: 1,
    24: 100.0, 25: 3000.0, 26: 250, 27: 5.0, 30: 1000, 31: 0, 32: 0, 100: 80.0, 101: 250.0, 102: 250.0,
    110: 6000.0, 111: 500.0, 112: 500.0, 120: 200.0, 121: 10.0, 122: 10.0, 130: 2900.0, 131: 200.0, 132: 200.0,
}  # fmt: skip
_REALS = {11, 12, 24, 25, 27} | set(range(100, 133))
_SWITCHES = {4, 5, 6, 13, 20, 21, 22, 32}
_BLOCKS = 15
_RX_BYTES = 127
_LINE_CHARS = 80
_BYTES_PER_S = 11520


class GrblFirmware:
    """Bytes in, bytes out, and a rail."""

    def __init__(self, rail: Rail | None = None, settings: dict[int, float] | None = None) -> None:
        self.rail = rail or Rail()
        self.settings: dict[int, float] = DEFAULTS | (settings or {})
        self.output = bytearray()
        self.boot_s = 0.0
        """Deaf after power-up, as a boot loader is."""
        self.cycle_start_s = 0.004
        """From a line's ``ok`` to motion: until then the state is a stale Idle."""
        self.truncated = 0
        self.now = 0.0
        self.machine_mm = 0.0
        self.work_offset_mm = 0.0
        self._wire: deque[int] = deque()
        self._wire_s = 0.0
        self.power_on()

    def power_on(self) -> None:
        """Start: the position is lost, and with homing on the machine is locked."""
        self.machine_mm = 0.0
        self.state = "Alarm" if self.settings[22] else "Idle"
        self._wire.clear()
        self._loop = self._main(self.now + self.boot_s)
        next(self._loop)

    # -- the world outside ---------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Bytes on the wire; they come in at the speed of the line."""
        self._wire.extend(data)

    def step(self, now: float) -> None:
        """Let time pass."""
        self._wire_s, self.now = self.now if not self._wire else self._wire_s, now
        bytes_now = max(1, int((now - self._wire_s) * _BYTES_PER_S))
        self._wire_s = now
        for _ in range(min(bytes_now, len(self._wire))):
            self._interrupt(self._wire.popleft())
            if self._rx and self._rx[-1] in b"\r\n":
                next(self._loop)
        self._move()
        next(self._loop)

    def press_reset(self) -> None:
        self._flags.add("reset")

    def press_hold(self) -> None:
        self._flags.add("hold")

    def open_door(self, *, stays_open: bool = False) -> None:
        """Open the safety door, and close it again: motion brakes, and waits for a resume."""
        self._door, self._ajar = True, stays_open
        self._flags.add("hold")

    def close_door(self) -> None:
        self._ajar = False

    @property
    def moving(self) -> bool:
        return self._motion is not None

    # -- interrupts ----------------------------------------------------------------------------------------------

    def _interrupt(self, byte: int) -> None:
        realtime = {0x18: "reset", 0x3F: "status", 0x21: "hold", 0x7E: "resume", 0x85: "jog-cancel"}
        if self._booting:
            return
        if byte in realtime:
            self._flags.add(realtime[byte])
        elif byte > 0x7F:
            change = {0x90: 0, 0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}.get(byte)
            if change is not None:
                self._override = 100 if change == 0 else min(200, max(10, self._override + change))
                self._override_age = 0
        elif len(self._rx) < _RX_BYTES:
            self._rx.append(byte)
        else:
            self.truncated += 1

    def _move(self) -> None:
        """Steps that the motor has made since we last looked."""
        if self._motion is None:
            return
        was_closed = self.rail.switch_closed
        position, self._speed = self._motion.at(self.now)
        steps = self.settings[100]
        position = round(position * steps) / steps
        if self.state == "Home" and not was_closed:  # stops at the very step that closes the switch
            position = max(position, self.machine_mm + self.rail.way_to_switch_mm)
        self.rail.push(position - self.machine_mm)
        self.machine_mm = position
        if self.settings[21] and self.state != "Home" and self.rail.switch_closed and not was_closed:
            self._kill("Alarm", 1)
        elif self.now >= self._motion.end_s:
            self._motion, self._speed = None, 0.0
            self._flags.add("cycle-stop")

    def trip_switch(self, closed: bool = True) -> None:
        """The limit switch closes by itself."""
        self.rail.stuck_switch = closed
        if closed and self.settings[21] and self.state in ("Run", "Jog", "Hold"):
            self._kill("Alarm", 1)

    def _kill(self, state: str, alarm: int) -> None:
        self._motion, self._speed = None, 0.0
        self._blocks.clear()
        self.state, self._alarm = state, alarm

    # -- main loop -----------------------------------------------------------------------------------------------

    def _main(self, start_s: float) -> Iterator[None]:
        self._initialise()
        self._booting = True
        yield
        while self.now < start_s:
            yield
        self._booting = False
        while True:
            self._say(b"\r\nGrbl 1.1h ['$' for help]\r\n")
            if self.settings[21] and self.rail.switch_closed:
                self._say_line("[MSG:Check Limits]")
                self.state = "Alarm"
            if self.state in ("Alarm", "Sleep"):
                self._say_line("[MSG:'$H'|'$X' to unlock]")
                self.state = "Alarm"
            elif self.state != "Check":
                self.state = "Idle"
            else:
                self.state = "Idle"
            if self._ajar and self.state == "Idle":
                self._say_line("[MSG:Check Door]")
                self.state, self._suspended, self._door = "Hold", True, True
            yield from self._protocol()
            self._initialise()

    def _initialise(self) -> None:
        self._rx = bytearray()
        self._flags: set[str] = set()
        self._abort = self._suspended = False
        self._alarm = 0
        self._blocks: deque[tuple[float, float]] = deque()
        self._start_at = float("inf")
        self._motion: Motion | None = None
        self._speed = 0.0
        self._modes = Modes()
        self._g92 = 0.0
        self._override, self._override_age, self._offset_age = 100, 0, 0

    def _protocol(self) -> Wait:
        line = bytearray()
        overlong = False
        while True:
            while self._rx:
                byte = self._rx.pop(0)
                if byte in b"\r\n":
                    yield from self._realtime()
                    if self._abort:
                        return
                    if overlong:
                        self._say_line("error:11")
                    else:
                        yield from self._line(clean(bytes(line)))
                    line.clear()
                    overlong = False
                    if self._abort:
                        return
                else:
                    line.append(byte)
                    overlong = len(clean(bytes(line))) >= _LINE_CHARS
            yield from self._realtime()
            if self._abort:
                return
            yield

    def _realtime(self) -> Wait:
        while True:
            self._start_cycle(self.now >= self._start_at)
            if self._alarm:
                code, self._alarm = self._alarm, 0
                self._say_line(f"ALARM:{code}")
                self.state = "Alarm"
                if code in (1, 2):
                    self._say_line("[MSG:Reset to continue]")
                    self._flags.discard("reset")
                    while "reset" not in self._flags:
                        self._flags.discard("status")
                        yield
            if "reset" in self._flags:
                self._reset()
                return
            if "status" in self._flags:
                self._flags.discard("status")
                self._report()
            self._obey_flags()
            if not self._suspended:
                return
            yield

    def _reset(self) -> None:
        if self.state in ("Run", "Jog", "Home") or (self.state == "Hold" and not self._suspended):
            self._say_line(f"ALARM:{6 if self.state == 'Home' else 3}")
            self._kill("Alarm", 0)
        self._abort = True
        self._suspended = self._door = False

    def _obey_flags(self) -> None:
        if self._flags & {"hold", "jog-cancel"}:
            if self.state == "Jog":
                self._brake()
                self._blocks.clear()
            elif "hold" in self._flags and self.state == "Run":
                self.state = "Hold"
                self._brake()
            elif "hold" in self._flags and self.state == "Idle":
                self.state, self._suspended = "Hold", True
            self._flags -= {"hold", "jog-cancel"}
        if "sleep" in self._flags:
            self._flags.discard("sleep")
            self._say_line("[MSG:Sleeping]")
            self.state, self._suspended = "Sleep", True
        if "resume" in self._flags:
            self._flags.discard("resume")
            if self.state == "Hold" and self._suspended and not self._ajar:
                self._suspended = self._door = False
                self.state = "Idle"
                self._start_cycle(True)
        if "cycle-stop" in self._flags:
            self._flags.discard("cycle-stop")
            if self.state == "Hold":
                self._suspended = not self._soft_limit_hold
            elif self._blocks:
                self._next_block()
            elif self.state in ("Run", "Jog"):
                self.state = "Idle"

    _soft_limit_hold = _door = _ajar = False

    # -- motion --------------------------------------------------------------------------------------------------

    def _brake(self) -> None:
        if self._motion is None:
            return
        position, speed = self._motion.at(self.now)
        if isinstance(self._motion, Trapezoid) and self.state == "Hold":
            self._blocks.appendleft((self._motion.target_mm, self._motion.speed))
        self._motion = Braking(self.now, position, speed or 1e-9, self.settings[120])

    def _start_cycle(self, due: bool) -> None:
        if due and self._blocks and self._motion is None and self.state in ("Idle", "Jog"):
            if self.state == "Idle":
                self.state = "Run"
            self._next_block()

    def _next_block(self) -> None:
        target, speed = self._blocks.popleft()
        self._start_at = float("inf")
        self._motion = Trapezoid(self.now, self.machine_mm, target, speed, self.settings[120])

    def _queue(self, target: float, mm_min: float) -> Wait:
        while len(self._blocks) >= _BLOCKS:
            self._start_cycle(True)
            yield
            yield from self._realtime()
            if self._abort:
                return
        speed = max(1e-3, min(mm_min, self.settings[110])) / 60
        if abs(target - self.machine_mm) * self.settings[100] < 0.5 and not self._blocks and self._motion is None:
            return  # a block of no steps is dropped
        if not self._blocks and self._motion is None:
            self._start_at = self.now + self.cycle_start_s
        self._blocks.append((target, speed))

    def _synchronise(self) -> Wait:
        self._start_cycle(True)
        while self._blocks or self._motion is not None or self.state == "Hold":
            yield
            yield from self._realtime()
            if self._abort:
                return
            self._start_cycle(True)

    def _beyond_travel(self, target: float) -> bool:
        return bool(self.settings[20]) and not -self.settings[130] <= target <= 0.0

    def _soft_limit(self) -> Wait:
        if self.state == "Run":
            self._soft_limit_hold = True
            self.state = "Hold"
            self._brake()
            while self._motion is not None:
                yield
                yield from self._realtime()
                if self._abort:
                    break
            self._soft_limit_hold = False
        self._kill("Alarm", 2)
        yield from self._realtime()

    # -- lines ---------------------------------------------------------------------------------------------------

    def _line(self, text: str) -> Wait:
        try:
            if not text:
                pass
            elif text.startswith("$"):
                yield from self._system(text)
            elif self.state in ("Alarm", "Jog"):
                raise RefusedError(9)
            else:
                yield from self._gcode(read_words(text))
        except RefusedError as refused:
            self._say_line(f"error:{refused.code}")
        else:
            self._say_line("ok")

    def _gcode(self, words: Words) -> Wait:
        modes = self._modes
        offset = self.work_offset_mm + self._g92
        motion = words.motion if words.motion is not None else modes.motion
        feed = words.values.get("F", modes.feed_mm_min) * (25.4 if 20 in words.g else 1.0)
        moves = "X" in words.values and not words.g & {10, 28, 30, 92}
        if 4 in words.g and "P" not in words.values:
            raise RefusedError(28)
        if 53 in words.g and motion not in (0, 1):
            raise RefusedError(30)
        if words.g & {1.0} and not moves and words.values.keys() & set("YZ") == set() and "F" not in words.values:
            raise RefusedError(26)
        if moves and motion == 1 and not feed:
            raise RefusedError(22)
        if moves and motion in (2, 3):
            raise RefusedError(35)
        target = target_mm(words, modes, self._planned_mm, offset)
        modes.motion, modes.feed_mm_min = motion, feed
        modes.inches = 20 in words.g or (modes.inches and 21 not in words.g)
        modes.absolute = 90 in words.g or (modes.absolute and 91 not in words.g)
        if 92 in words.g:
            self._g92, self._offset_age = self._planned_mm - self.work_offset_mm - words.values.get("X", 0.0), 0
        if 92.1 in words.g:
            self._g92, self._offset_age = 0.0, 0
        if words.m & {2, 30}:
            yield from self._synchronise()
            self._say_line("[MSG:Pgm End]")
            self._modes = Modes()
        elif 4 in words.g and self.state != "Check":
            yield from self._synchronise()
            until = self.now + words.values["P"]
            while self.now < until and not self._abort:
                yield
                yield from self._realtime()
        elif moves:
            if self._beyond_travel(target):
                yield from self._soft_limit()
            elif self.state != "Check":
                rate = self.settings[110] if motion == 0 else feed * self._override / 100
                yield from self._queue(target, rate)

    @property
    def _planned_mm(self) -> float:
        if self._blocks:
            return self._blocks[-1][0]
        return self._motion.target_mm if isinstance(self._motion, Trapezoid) else self.machine_mm

    def _jog(self, text: str) -> Wait:
        if self.state not in ("Idle", "Jog"):
            raise RefusedError(8)
        words = read_words(text)
        if words.g & {2, 3}:
            raise RefusedError(35)
        if words.g & (_FORBIDDEN_IN_JOG) or words.m:
            raise RefusedError(16)
        if not words.values.get("F"):
            raise RefusedError(22)
        # Without an axis word real firmware drives to work zero.
        target = (
            target_mm(words, Modes(inches=self._modes.inches), self._planned_mm, self.work_offset_mm + self._g92)
            if "X" in words.values
            else self.work_offset_mm + self._g92
        )
        if self._beyond_travel(target):
            raise RefusedError(15)
        yield from self._queue(target, words.values["F"])
        if self._blocks and self.state == "Idle":
            self.state, self._start_at = "Jog", self.now

    def _system(self, text: str) -> Wait:
        if text == "$":
            self._say_line("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif text.startswith("$J="):
            yield from self._jog(text[3:])
        elif text == "$$":
            if self.state in ("Run", "Hold"):
                raise RefusedError(8)
            for number, value in self.settings.items():
                self._say_line(f"${number}={value:.3f}" if number in _REALS else f"${number}={value:.0f}")
        elif text == "$G":
            m = self._modes
            self._say_line(
                f"[GC:G{m.motion:g} G54 G17 G{20 if m.inches else 21} G{90 if m.absolute else 91} G94 M5 M9 T0 "
                f"F{m.feed_mm_min:.0f} S0]"
            )
        elif text == "$C":
            yield from self._check_mode()
        elif text == "$X":
            if self.state == "Alarm":
                self._say_line("[MSG:Caution: Unlocked]")
                self.state = "Idle"
        elif self.state not in ("Idle", "Alarm"):
            raise RefusedError(8)
        elif text == "$H":
            if not self.settings[22]:
                raise RefusedError(5)
            yield from self._home()
        elif text == "$I":
            self._say_line("[VER:1.1h.20190830:]")
            self._say_line("[OPT:V,15,128]")
        elif text == "$#":
            for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92"):
                x = {"G54": self.work_offset_mm, "G92": self._g92}.get(name, 0.0)
                self._say_line(f"[{name}:{x:.3f},0.000,0.000]")
            self._say_line("[TLO:0.000]")
            self._say_line("[PRB:0.000,0.000,0.000:0]")
        elif text == "$SLP":
            self._flags.add("sleep")
        else:
            self._set(text)

    def _check_mode(self) -> Wait:
        if self.state == "Check":
            self._say_line("[MSG:Disabled]")
            self._flags.add("reset")
        elif self.state == "Idle":
            self.state = "Check"
            self._say_line("[MSG:Enabled]")
        else:
            raise RefusedError(8)
        yield from ()

    def _set(self, text: str) -> None:
        name, _, value = text[1:].partition("=")
        try:
            number, wanted = int(name), float(value)
        except ValueError:
            raise RefusedError(2) from None
        if wanted < 0:
            raise RefusedError(4)
        if number not in self.settings:
            raise RefusedError(3)
        if number == 0 and wanted < 3:
            raise RefusedError(6)
        if number == 20 and wanted and not self.settings[22]:
            raise RefusedError(10)
        self.settings[number] = float(bool(wanted)) if number in _SWITCHES else wanted
        if number == 22 and not wanted:
            self.settings[20] = 0

    def _home(self) -> Wait:
        self.state = "Home"
        towards = -1.0 if int(self.settings[23]) & 1 else 1.0
        pull_off, seek, feed = self.settings[27], self.settings[25] / 60, self.settings[24] / 60
        legs = [
            (towards * 1.5 * self.settings[130], seek, True),
            (-towards * pull_off, seek, False),
            (towards * 5 * pull_off, feed, True),
            (-towards * pull_off, feed, False),
        ]
        for distance, speed, approach in legs:
            self.machine_mm = 0.0  # each leg counts anew
            self._motion = Trapezoid(self.now, 0.0, distance, speed, self.settings[120])
            while self._motion is not None and not (approach and self.rail.switch_closed):
                yield
                if "reset" in self._flags:
                    self._kill("Alarm", 6)
                    return (yield from self._realtime())
            found, self._motion = self.rail.switch_closed, None
            if found != approach:
                self._kill("Alarm", 9 if approach else 8)
                self._flags.add("reset")
                return (yield from self._realtime())
            pause = self.now + self.settings[26] / 1000
            while self.now < pause:
                yield
        self._flags.discard("cycle-stop")
        self.machine_mm = pull_off - self.settings[130] if towards < 0 else -pull_off
        yield from self._realtime()
        if not self._abort:
            self.state = "Idle"

    # -- reports -------------------------------------------------------------------------------------------------

    def _report(self) -> None:
        unit, digits = (25.4, 4) if self.settings[13] else (1.0, 3)
        offset = self.work_offset_mm + self._g92
        flags = int(self.settings[10])
        place = self.machine_mm if flags & 1 else self.machine_mm - offset

        def vector(x: float) -> str:
            return f"{x / unit:.{digits}f},{0:.{digits}f},{0:.{digits}f}"

        state = self.state
        if state == "Hold" and self._door:
            state = ("Door:1" if self._ajar else "Door:0") if self._suspended else "Door:2"
        elif state == "Hold":
            state += ":0" if self._suspended else ":1"
        parts = [state, f"{'MPos' if flags & 1 else 'WPos'}:{vector(place)}"]
        if flags & 2:
            parts.append(f"Bf:{_BLOCKS - len(self._blocks)},128")
        rate = abs(self._speed) * 60 / unit
        parts.append(f"FS:{rate:.1f},0" if self.settings[13] else f"FS:{rate:.0f},0")
        if self.rail.switch_closed:
            parts.append("Pn:X")
        busy = self.state in ("Home", "Run", "Hold", "Jog")
        if self._offset_age:
            self._offset_age -= 1
        else:
            self._offset_age = 29 if busy else 9
            self._override_age = self._override_age or 1
            parts.append(f"WCO:{vector(offset)}")
        if self._override_age:
            self._override_age -= 1
        else:
            self._override_age = 19 if busy else 9
            parts.append(f"Ov:{self._override},100,100")
        self._say_line(f"<{'|'.join(parts)}>")

    def _say_line(self, text: str) -> None:
        self._say(text.encode("latin-1") + b"\r\n")

    def _say(self, data: bytes) -> None:
        self.output += data


_FORBIDDEN_IN_JOG = {0.0, 1.0, 4.0, 10.0, 28.0, 30.0, 92.0}
