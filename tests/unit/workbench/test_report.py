import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from drawn_results import SUSPECT_INDEX, draw_bank, draw_measurement, no_texture, posterior, score_estimate

from workbench.report import write_bank_report, write_measurement_report
from workbench.report.measurement import CURVES_PER_FIGURE, MAX_CURVES


class Page(HTMLParser):
    """Text, addresses, tags and tables' cells of a page; complains about tags that don't match."""

    VOID = frozenset({"meta", "link", "img", "br"})

    def __init__(self, source: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.alts: list[str] = []
        self.rows: list[list[str]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(source)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        given = dict(attrs)
        self.addresses += [value for key in ("src", "href", "data", "srcset") if (value := given.get(key))]
        if tag == "img":
            self.alts.append(given.get("alt") or "")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self._open:
            return
        self.words.append(data)
        if self.rows and {"td", "th"} & set(self._open):
            self.rows[-1][-1] += data

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def row(self, first: str) -> list[str]:
        """The table row whose first cell is this."""
        return next(row for row in self.rows if row and row[0].strip() == first)


def read(path: Path) -> tuple[str, Page]:
    source = path.read_text(encoding="utf-8")
    return source, Page(source)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Page]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_measurement_report(
        draw_measurement(), draw_bank(), path, true_depths_mm={1: 3200.0, 4: 880.0}, names={1: "wall", 4: "ball"}
    )
    return read(path)


@pytest.fixture(scope="module")
def bank_page(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Page]:
    path = tmp_path_factory.mktemp("report") / "bank.html"
    write_bank_report(draw_bank(fields=5), path, version="v3")
    return read(path)


@pytest.mark.parametrize("which", ["measured", "bank_page"])
def test_a_report_needs_no_other_file_and_no_script(which: str, request: pytest.FixtureRequest) -> None:
    source, page = request.getfixturevalue(which)
    assert page.addresses
    assert all(address.startswith("data:") for address in page.addresses)
    assert not {"script", "iframe", "object", "embed"} & set(page.tags)
    outside_pictures = re.sub(r'"data:[^"]*"', "", source)
    assert not re.search(r"(?i)https?://|url\(|@import|file:", outside_pictures)
    assert len(source) < 6e6


@pytest.mark.parametrize("which", ["measured", "bank_page"])
def test_every_picture_has_a_title_a_number_and_a_caption(which: str, request: pytest.FixtureRequest) -> None:
    source, page = request.getfixturevalue(which)
    pictures = page.tags.count("img")
    assert page.tags.count("figcaption") == page.tags.count("figure") == pictures >= 4
    assert all(page.alts)
    assert [int(n) for n in re.findall(r"<b>Figure (\d+)\.", source)] == list(range(1, pictures + 1))


def test_the_table_comes_first_and_holds_each_regions_numbers(measured: tuple[str, Page]) -> None:
    source, page = measured
    assert source.index("<table") < source.index("<figure")
    cells = [cell.strip() for cell in page.row("1")]
    assert cells[1:3] == ["wall", "321.2"]
    assert cells[4:6] == ["320.0", "+1.2"]
    assert "313.2 to 329.7" in cells
    assert "106.5" in cells
    assert "< 0.001" in cells
    assert "0.380" in page.row("3")
    assert page.row("3")[-1].split() == ["▲", "ambiguous"]
    assert "1396 mm explains the region nearly as well" in page.text
    assert page.row("4")[5].strip() == "−0.6"


def test_a_region_without_texture_shows_its_reason_and_dashes(measured: tuple[str, Page]) -> None:
    source, page = measured
    cells = [cell.strip() for cell in page.row("2")]
    assert cells[2:4] == ["–", "–"]
    assert cells[-1].split() == ["✕", "no-texture"]
    assert "Region 2: contrast is within the noise <0.4 %>" in page.text
    assert not re.search(r"\bnan\b", re.sub(r'"data:[^"]*"', "", source), re.IGNORECASE)


@pytest.mark.parametrize(
    ("odds", "note"),
    [
        (3.42, "speak for this side of focus (3.4 nats)"),
        (-1.5, "speak against this side of focus (1.5 nats)"),
        (0.5, ""),
    ],
)
def test_a_region_says_what_its_outlines_tell(odds: float, note: str, tmp_path: Path) -> None:
    told = dataclasses.replace(posterior(3212.0, 2e-6, 0.01), outline_odds=odds)
    write_measurement_report(draw_measurement({1: told}, channels=1), draw_bank(), tmp_path / "r.html")
    text = Page((tmp_path / "r.html").read_text(encoding="utf-8")).text
    assert f"Region 1: its outlines {note}" in text if note else "outlines" not in text


def test_provenance_names_photograph_bank_method_options_and_software(measured: tuple[str, Page]) -> None:
    _, page = measured
    for word in ("cd" * 32, "0123456789abcdef", "evidence", "srm q", "prior = 1/f", "1/125 s", "Canon EOS 650D",
                 "480 × 320 photosites RGGB", "8.6 µm", "depth-workbench 0.1.0", "depth.png"):  # fmt: skip
        assert word in page.text, word


def test_a_measurement_in_which_nothing_has_a_depth_is_still_a_report(tmp_path: Path) -> None:
    write_measurement_report(draw_measurement({1: no_texture()}, channels=1), draw_bank(), tmp_path / "r.html")
    _, page = read(tmp_path / "r.html")
    assert "No region has a depth." in page.text
    assert not any("perspective" in alt for alt in page.alts)


def test_scores_are_not_sold_as_probabilities_and_their_workings_are_shown(tmp_path: Path) -> None:
    estimates = {1: no_texture(), 4: score_estimate(1200.0)}
    write_measurement_report(draw_measurement(estimates), draw_bank(), tmp_path / "r.html")
    _, page = read(tmp_path / "r.html")
    assert "no probabilities" in page.text
    assert sum(alt.startswith("Edge maps") for alt in page.alts) == 1
    assert sum(alt.startswith("Threshold") for alt in page.alts) == 1
    assert "region 4 at 120 cm" in page.text


def test_very_many_regions_stay_readable(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    measurement = draw_measurement()
    labels = (np.arange(measurement.labels.size).reshape(measurement.labels.shape) % 240 // 8 + 1).astype(np.int32)
    estimates = {n: posterior(float(rng.uniform(700, 3300)), 1e-5, 0.1, pixels=100 + n) for n in range(1, 31)}
    many = dataclasses.replace(measurement, labels=labels, estimates=estimates)
    write_measurement_report(many, draw_bank(), tmp_path / "r.html")
    source, page = read(tmp_path / "r.html")
    assert all(page.row(str(n)) for n in range(1, 31))
    assert sum(alt.startswith("What each region") for alt in page.alts) == MAX_CURVES // CURVES_PER_FIGURE
    assert "The 6 smallest regions are in the table only" in page.text
    assert len(source) < 6e6


def test_a_suspect_frame_and_a_rejected_one_are_named(bank_page: tuple[str, Page]) -> None:
    _, page = bank_page
    assert "260 cm: residual" in page.text
    cells = page.row("260.00")
    assert cells[-1].split()[:2] == ["▲", "suspect:"]
    assert "psf_260cm_1.dng, psf_260cm_2.dng" in cells[-1]
    assert "+0.310" in cells
    assert "psf_175cm_1.dng (175 cm): saturated" in page.text
    assert sum("suspect" in row[-1] for row in page.rows if row and row[0].endswith(".00")) == 1


def test_a_bank_report_states_the_lens_with_standard_errors_and_where_it_all_came_from(
    bank_page: tuple[str, Page],
) -> None:
    _, page = bank_page
    assert draw_bank(fields=5).id in page.text
    assert ", v3" in page.text
    assert page.row("Focus distance")[1:4] == ["160.00", "0.021", "cm"]
    assert page.row("Stage zero")[1:4] == ["0.703", "0.0120", "cm"]
    assert page.row("Blur radius at infinity")[1:4] == ["8.000", "0.0030", "px"]
    for word in ("superpixel", "8.6 µm", "ab" * 32, "EOS 650D", "0123456789", "480 × 320", "simulated small"):
        assert word in page.text, word
    assert len([row for row in page.rows if row and row[0].endswith(".dng")]) == 60


def test_a_residual_is_also_told_in_centimetres(bank_page: tuple[str, Page]) -> None:
    bank = draw_bank()
    depth = float(bank.depths_mm[SUSPECT_INDEX])
    linear_cm = depth**2 / (bank.lens.focus_mm * bank.lens.scale_px) * 0.31 / 10
    assert float(bank_page[1].row("260.00")[5]) == pytest.approx(linear_cm, rel=0.2)


def test_an_imported_bank_that_knows_little_has_a_report_too(tmp_path: Path) -> None:
    write_bank_report(draw_bank(judged=False), tmp_path / "r.html")
    _, page = read(tmp_path / "r.html")
    assert "an unnamed camera" in page.text
    assert not any(alt.startswith("Quality") for alt in page.alts)
    assert "▲" in page.row("260.00")[-1]


def test_what_files_say_about_themselves_cannot_break_the_page(tmp_path: Path) -> None:
    nasty = dataclasses.replace(draw_measurement({1: no_texture()}), image_name='<img src="http://x/y.png">&.dng')
    write_measurement_report(nasty, draw_bank(), tmp_path / "r.html")
    source, page = read(tmp_path / "r.html")
    assert all(address.startswith("data:") for address in page.addresses)
    assert "&lt;img" in source


def test_a_report_that_cannot_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "r.html").mkdir()
    with pytest.raises(OSError, match=r"r\.html"):
        write_bank_report(draw_bank(judged=False), tmp_path / "r.html")
    assert [p.name for p in tmp_path.iterdir()] == ["r.html"]
