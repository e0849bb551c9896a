"""From outcomes to the tables of an accuracy run: rows for the terminal, Markdown, JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from workbench.bench.cases import BLANK
from workbench.bench.interval_coverage import Coverage, coverage_of
from workbench.bench.method_speed import MemoryRow, MethodRow
from workbench.bench.scoring import Figures, Outcome, grouped, split
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


def _method_and_size(o: Outcome) -> tuple[str, str]:
    return o.method, o.size


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

_COVERAGE_COLUMNS = ("n", "in 95 %", "95 % conf.", "± cm")
_COVERAGE_GROUPINGS: Mapping[str, Key] = {
    **{name: GROUPINGS[name][1] for name in ("texture", "depth")}, "size": _method_and_size
}  # fmt: skip


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
        methods measured different cases, their comparison on those that all did; how many intervals hold the truth, in
        one light; abstentions on the blank wall.
    """
    textured = [o for o in outcomes if o.texture != BLANK]
    normal = [o for o in textured if o.light == "normal"] or textured
    tables = []
    for name, (parts, key) in GROUPINGS.items():
        chosen = textured if name == "size and light" else normal
        title = f"By {name}" + _light(chosen)
        tables.append(figures_table(title, " ".join(parts), _ordered(grouped(chosen, key, focus_mm), name)))
    tables += _comparison(textured, focus_mm)
    tables += _coverage_table(_in_one_light(textured))
    blank = [o for o in outcomes if o.texture == BLANK]
    if blank:
        tables.append(_blank_table(blank))
    return tables


def _in_one_light(outcomes: Sequence[Outcome]) -> Sequence[Outcome]:
    """Those in normal light, or else in the first light that there is."""
    lights = [o.light for o in outcomes]
    return [o for o in outcomes if o.light == ("normal" if "normal" in lights else lights[0])]


def _light(outcomes: Sequence[Outcome]) -> str:
    """What a title says of the light, where there is but one."""
    lights = {o.light for o in outcomes} - {""}
    return f" ({lights.pop()} light)" if len(lights) == 1 else ""


Group = TypeVar("Group")


def _ordered(groups: Mapping[tuple[str, ...], Group], name: str) -> dict[tuple[str, ...], Group]:
    """Methods side by side within each group; depth bands from near to far."""
    methods = list(dict.fromkeys(key[0] for key in groups))
    parts = list(dict.fromkeys(key[1:] for key in groups))
    if name == "depth":
        parts = [(band_name(low),) for low, _ in BANDS_MM]
    return dict(sorted(groups.items(), key=lambda item: (parts.index(item[0][1:]), methods.index(item[0][0]))))


def _coverage_table(outcomes: Sequence[Outcome]) -> list[TableOf]:
    """A row per texture, band of depths or size and method: all intervals, unmarked ones. None where there are none."""
    columns = ("method", "by", "regions", *_COVERAGE_COLUMNS, *(f"unm. {name}" for name in _COVERAGE_COLUMNS))
    rows = [(*names, *_coverage_cells(every), *_coverage_cells(unmarked)) for names, every, unmarked in
            _coverages(outcomes)]  # fmt: skip
    return [TableOf("Intervals of 95 %" + _light(outcomes), columns, tuple(rows))] if rows else []


def _coverages(outcomes: Sequence[Outcome]) -> Iterator[tuple[tuple[str, str, str], Coverage, Coverage]]:
    """Method, grouping and group; coverage of its intervals, and of those of them that are unmarked."""
    for by, key in _COVERAGE_GROUPINGS.items():
        for (method, name), group in _ordered(split((o for o in outcomes if o.has_interval), key), by).items():
            yield (method, by, name), coverage_of(group), coverage_of([o for o in group if not o.marked])


def _coverage_cells(c: Coverage) -> tuple[Cell, ...]:
    low, high = c.confidence_interval
    between = f"{percent(low)} to {percent(high)}" if c.count else "-"
    return c.count, percent(c.coverage), between, _number(c.half_width_cm)


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
    return f"{o.depth_mm / 10:.1f}{'?' * o.marked}{'*' * (not o.interval_holds)}"


def _comparison(outcomes: Sequence[Outcome], focus_mm: float) -> list[TableOf]:
    """Methods on the cases that all of them measured, where that isn't what the other tables show."""
    by_method: dict[str, set[tuple[object, ...]]] = {}
    for o in outcomes:
        by_method.setdefault(o.method, set()).add(_case_of(o))
    common = set.intersection(*by_method.values()) if by_method else set()
    if len(by_method) < 2 or all(cases == common for cases in by_method.values()) or not common:
        return []
    chosen = [o for o in outcomes if _case_of(o) in common]
    groups = grouped(chosen, _method_and_size, focus_mm)
    return [figures_table("Side by side: the regions that every method measured", "size", _ordered(groups, "size"))]


def _case_of(o: Outcome) -> tuple[object, ...]:
    return o.texture, o.size, o.light, o.true_mm


def _blank_table(blank: Sequence[Outcome]) -> TableOf:
    rows = tuple(
        (method, size, len(group), percent(sum(not o.answered for o in group) / len(group)))
        for (method, size), group in split(blank, _method_and_size).items()
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
texture of known spectrum. In 95 %: the interval holds the truth. Time: median per region, all regions of a frame
measured together, of simulated planes on one core; of regions found in a photograph, finding them and the all-focus
image included.

In the table of intervals n counts answers that have one, and unm. those of them that are not called ambiguous. 95 %
conf.: confidence interval of the share that holds the truth (Clopper and Pearson 1934), for as many independent regions
as scatter like these, which share frames (Korn and Graubard 1998). ± cm: median of half their widths."""


def tables_json(outcomes: Sequence[Outcome], focus_mm: float) -> dict[str, list[dict[str, Any]]]:
    """Figures of every table, by name of the grouping, as plain numbers.

    Those by texture and by depth are of all lights together; the intervals of one, which is named.
    """
    textured = [o for o in outcomes if o.texture != BLANK]
    result: dict[str, list[dict[str, Any]]] = {}
    for name, (parts, key) in GROUPINGS.items():
        result[name] = [
            {"method": group[0], **dict(zip(parts, group[1:], strict=False)), **asdict(figures)}
            for group, figures in grouped(textured, key, focus_mm).items()
        ]
    one = _in_one_light(textured)
    result["intervals"] = [
        {"method": method, "by": by, "regions": name, "light": one[0].light, "all": asdict(every),
         "unmarked": asdict(unmarked)}
        for (method, by, name), every, unmarked in _coverages(one)
    ]  # fmt: skip
    return result
