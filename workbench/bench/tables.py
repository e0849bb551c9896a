"""From outcomes to the tables of an accuracy run: rows for the terminal, Markdown, JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from workbench.bench.cases import BLANK
from workbench.bench.intervals import Held, held
from workbench.bench.method_speed import MemoryRow, MethodRow
from workbench.bench.scoring import Figures, Outcome, grouped
from workbench.bench.speed import SpeedRow

BANDS_MM = ((0.0, 1000.0), (1000.0, 1400.0), (1400.0, 1800.0), (1800.0, 2500.0), (2500.0, math.inf))
"""Depth bands; the third is within 20 cm of the focal plane."""

Cell = str | int


@dataclass(frozen=True, slots=True)
class TableOf:
    """One table: a title, names of columns, and rows of texts."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def markdown(self) -> str:
        """As GitHub writes tables; all columns but the first right aligned."""
        lines = [f"### {self.title}", "", _line(self.columns), _line(["---"] + ["---:"] * (len(self.columns) - 1))]
        return "\n".join([*lines, *(_line(row) for row in self.rows), ""])


def _line(cells: Iterable[Cell]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def band_name(depth_mm: float) -> str:
    """Depth band of a truth, as text."""
    low, high = next(band for band in BANDS_MM if band[0] <= depth_mm < band[1])
    if math.isinf(high):
        return f"beyond {low / 10:.0f} cm"
    return f"{low / 10:.0f} to {high / 10:.0f} cm" if low else f"nearer than {high / 10:.0f} cm"


Key = Callable[[Outcome], tuple[str, ...]]
GROUPINGS: Mapping[str, tuple[tuple[str, ...], Key]] = {
    "size and light": (("size", "light"), lambda o: (o.method, o.size, *([o.light] if o.light else []))),
    "texture": (("texture",), lambda o: (o.method, o.texture)),
    "depth": (("depth",), lambda o: (o.method, band_name(o.true_mm))),
}
_FIGURE_COLUMNS = (
    "method", "", "n", "answered", "unmarked", "exact", "±15 cm", "±10 cm", "gross", "unm. gross", "flips",
    "RMS cm", "RMS 1/m", "fine cm", "bound cm", "in 95 %", "time",
)  # fmt: skip

_HELD_COLUMNS = ("n", "hold", "between", "± cm")


def accuracy_tables(outcomes: Sequence[Outcome], focus_mm: float) -> list[TableOf]:
    """All tables of a run.

    Parameters
    ----------
    outcomes
        Raw results.
    focus_mm
        Focus distance, which tells the sides apart.

    Returns
    -------
    list of TableOf
        By size and light; by texture and by depth band (all sizes in normal light, or the lights there are); where the
        methods measured different cases, their comparison on those that all did; how many intervals hold the truth;
        abstentions on the blank wall.
    """
    textured = [o for o in outcomes if o.texture != BLANK]
    normal = _in_normal_light(textured)
    tables = []
    for name, (parts, key) in GROUPINGS.items():
        chosen = textured if name == "size and light" else normal
        title = f"By {name}" + ("" if len({o.light for o in chosen}) > 1 else _light(chosen))
        tables.append(figures_table(title, " ".join(parts), _ordered(grouped(chosen, key, focus_mm), name)))
    tables += _comparison(textured, focus_mm)
    if any(o.has_interval for o in normal):
        tables.append(_intervals_table("Intervals of 95 %" + _light(normal), normal))
    blank = [o for o in outcomes if o.texture == BLANK]
    if blank:
        tables.append(_blank_table(blank))
    return tables


def _in_normal_light(outcomes: Sequence[Outcome]) -> Sequence[Outcome]:
    """Those in normal light, or all where there are none."""
    return [o for o in outcomes if o.light == "normal"] or outcomes


def _light(outcomes: Sequence[Outcome]) -> str:
    return f" ({outcomes[0].light} light)" if outcomes and outcomes[0].light else ""


def _ordered(groups: Mapping[tuple[str, ...], Figures], name: str) -> dict[tuple[str, ...], Figures]:
    """Methods side by side within each group; depth bands from near to far."""
    methods = list(dict.fromkeys(key[0] for key in groups))
    parts = list(dict.fromkeys(key[1:] for key in groups))
    if name == "depth":
        parts = [(band_name(low),) for low, _ in BANDS_MM]
    return dict(sorted(groups.items(), key=lambda item: (parts.index(item[0][1:]), methods.index(item[0][0]))))


def _intervals_table(title: str, outcomes: Sequence[Outcome]) -> TableOf:
    """One row per method and texture, band of depths or size; all that have an interval, and those of them unmarked."""
    columns = ("method", "regions", *_HELD_COLUMNS, *(f"unm. {name}" for name in _HELD_COLUMNS))
    rows = [(*names, *_held_cells(every), *_held_cells(unmarked)) for names, every, unmarked in _intervals(outcomes)]
    return TableOf(title, columns, tuple(rows))


def _intervals(outcomes: Sequence[Outcome]) -> Iterator[tuple[tuple[str, str], Held, Held]]:
    """Of each method by texture, by band and by size: names, all that have an interval, those of them unmarked."""
    for method in dict.fromkeys(o.method for o in outcomes if o.has_interval):
        own = [o for o in outcomes if o.method == method]
        groups = {name: [o for o in own if o.texture == name] for name in dict.fromkeys(o.texture for o in own)}
        for name in (band_name(low) for low, _ in BANDS_MM):
            groups[name] = [o for o in own if band_name(o.true_mm) == name]
        groups |= {name: [o for o in own if o.size == name] for name in dict.fromkeys(o.size for o in own)}
        for name, group in groups.items():
            if any(o.has_interval for o in group):
                yield (method, name), held(group), held(group, unmarked=True)


def _held_cells(h: Held) -> tuple[Cell, ...]:
    low, high = h.between
    between = f"{100 * low:.1f} to {100 * high:.1f}" if h.count else "-"
    return h.count, percent(h.share), between, _number(h.half_width_cm)


def figures_table(title: str, group: str, groups: Mapping[tuple[str, ...], Figures]) -> TableOf:
    """One row per group; the group's first part is the method."""
    columns = (_FIGURE_COLUMNS[0], group, *_FIGURE_COLUMNS[2:])
    return TableOf(title, columns, tuple((key[0], ", ".join(key[1:]), *_cells(f)) for key, f in groups.items()))


def _cells(f: Figures) -> tuple[str, ...]:
    return (
        str(f.count), percent(f.answered), percent(f.unmarked), percent(f.exact), percent(f.neighbour),
        percent(f.within_10cm), percent(f.gross), percent(f.unmarked_gross), percent(f.side_flips), _number(f.rms_cm),
        _number(f.rms_dioptres, 3), _number(f.fine_rms_cm), _number(f.bound_cm), percent(f.coverage),
        _seconds(f.seconds),
    )  # fmt: skip


def percent(fraction: float) -> str:
    """``0.123`` -> ``12.3``; a dash for NaN."""
    return f"{100 * fraction:.1f}" if math.isfinite(fraction) else "-"


def _number(value: float, digits: int = 1) -> str:
    """Enough digits to see small numbers; a dash for NaN."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.{digits}f}" if abs(value) >= 1 else f"{value:.{max(digits, 2)}f}"


def _seconds(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:.2f} s" if value >= 1 else f"{1000 * value:.0f} ms"


def singles_table(singles: Sequence[tuple[str, Outcome]]) -> TableOf:
    """One row for each named plane or object and way of measuring it, one column for each method.

    A cell holds the depth in cm; a question mark where it is called ambiguous, a star where the 95 % interval misses
    the truth; the status where there is no depth.
    """
    methods = tuple(dict.fromkeys(outcome.method for _, outcome in singles))
    rows: dict[tuple[str, str], dict[str, Outcome]] = {}
    for name, outcome in singles:
        rows.setdefault((name, outcome.size), {})[outcome.method] = outcome
    return TableOf(
        "One by one, cm (? called ambiguous, * truth outside the 95 % interval)",
        ("", "region", "true", *methods),
        tuple(
            (name, size, f"{next(iter(row.values())).true_mm / 10:.1f}",
             *(_single_cell(row[m]) if m in row else "-" for m in methods))
            for (name, size), row in rows.items()
        ),
    )  # fmt: skip


def _single_cell(o: Outcome) -> str:
    if not o.answered:
        return o.status
    low, high = o.interval_mm
    return f"{o.depth_mm / 10:.1f}{'?' * (o.status == 'ambiguous')}{'*' * (not low <= o.true_mm <= high)}"


def _comparison(outcomes: Sequence[Outcome], focus_mm: float) -> list[TableOf]:
    """Methods on the cases that all of them measured, where that isn't what the other tables show."""
    by_method: dict[str, set[tuple[object, ...]]] = {}
    for o in outcomes:
        by_method.setdefault(o.method, set()).add(_case_of(o))
    common = set.intersection(*by_method.values()) if by_method else set()
    if len(by_method) < 2 or all(cases == common for cases in by_method.values()) or not common:
        return []
    chosen = [o for o in outcomes if _case_of(o) in common]
    groups = grouped(chosen, lambda o: (o.method, o.size), focus_mm)
    return [figures_table("Side by side: the regions that every method measured", "size", _ordered(groups, "size"))]


def _case_of(o: Outcome) -> tuple[object, ...]:
    return o.texture, o.size, o.light, o.true_mm


def _blank_table(blank: Sequence[Outcome]) -> TableOf:
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for o in blank:
        groups.setdefault((o.method, o.size), []).append(o)
    rows = tuple(
        (method, size, len(group), percent(sum(not o.answered for o in group) / len(group)))
        for (method, size), group in groups.items()
    )
    return TableOf("A blank wall", ("method", "size", "n", "refused"), rows)


SPEED_COLUMNS = ("20 iterations of Richardson-Lucy", "median", "fastest", "x transforms", "faster than scikit-image",
                 "largest difference")  # fmt: skip


def speed_tables(
    kernels: Sequence[SpeedRow], methods: Sequence[MethodRow], memory: Sequence[MemoryRow], frame: str, processors: int
) -> list[TableOf]:
    """Tables of ``bench speed``; those without rows are left out."""
    whole = f"Whole methods: {frame}, one thread"
    alone = f"Measuring in a process of its own: {frame}, {processors} processor{'s' if processors > 1 else ''}"
    tables = [
        TableOf("Deconvolution", SPEED_COLUMNS, tuple(
            (r.name, _seconds(r.median_s), _seconds(r.fastest_s), f"{r.times_floor:.2f}", _factor(r.speed_up),
             f"{r.largest_difference:.1e}" if math.isfinite(r.largest_difference) else "-")
            for r in kernels
        )),
        TableOf(whole, ("method", "time", "faster than sharpness", "depths timed"), tuple(
            (r.name, _seconds(r.seconds), _factor(r.speed_up), f"{r.scaled}, scaled to all" if r.scaled else "all")
            for r in methods
        )),
        TableOf(alone, ("method", "peak memory", "time", "regions"), tuple(
            (r.method, f"{r.peak_bytes / 1e9:.2f} GB", _seconds(r.seconds), r.regions) for r in memory
        )),
    ]  # fmt: skip
    return [table for table in tables if table.rows]


def _factor(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"


def markdown_page(title: str, facts: Mapping[str, object], tables: Sequence[TableOf], figures: Sequence[str]) -> str:
    """Whole page: facts of the run, what the columns mean, figures, tables."""
    lines = [f"# {title}", "", *(f"- {name}: {value}" for name, value in facts.items()), "", COLUMN_NOTES, ""]
    lines += [line for name in figures for line in (f"![{name}]({name})", "")]
    return "\n".join(lines) + "\n" + "\n".join(table.markdown() for table in tables)


COLUMN_NOTES = """n: regions; what counts regions is in per cent. Answered: a depth was given; unmarked: given, and not
called ambiguous. Both, and the gross ones, are fractions of all regions; the others of the answered ones. Exact: within
5 cm, so that rounding to the 10 cm grid gives the truth. Gross: off by more than 40 cm; unm. gross: and not called
ambiguous. Flips: not exact, on the wrong side of focus and nearer to the mirror depth than to the focal plane. Fine:
RMS error of answers neither gross nor flipped; beside it the Cramer-Rao bound of the same regions, for a Gaussian
texture of known spectrum. In 95 %: the interval holds the truth. Among the intervals, between: shares that so many may
come from, with 95 % confidence (Clopper and Pearson 1934), as if regions were independent; ± cm: median of half their
widths. Time: median per region, all regions of a
frame measured together, of simulated planes on one core; of regions found in a photograph, finding them and the
all-focus image included."""


def tables_json(outcomes: Sequence[Outcome], focus_mm: float) -> dict[str, list[dict[str, Any]]]:
    """Figures of every table, by name of the grouping, as plain numbers."""
    textured = [o for o in outcomes if o.texture != BLANK]
    result: dict[str, list[dict[str, Any]]] = {}
    for name, (parts, key) in GROUPINGS.items():
        result[name] = [
            {"method": group[0], **dict(zip(parts, group[1:], strict=False)), **asdict(figures)}
            for group, figures in grouped(textured, key, focus_mm).items()
        ]
    result["intervals"] = [
        {"method": method, "regions": name, "all": asdict(every), "unmarked": asdict(unmarked)}
        for (method, name), every, unmarked in _intervals(_in_normal_light(textured))
    ]
    return result
