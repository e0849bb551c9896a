"""From pattern to drawing: brightness in linear light, bad values, pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rigs.charts import chart, leaves
from rigs.errors import PanelError
from rigs.panel_patterns import Picture, dimmed, drawing, srgb_decoded, srgb_encoded
from rigs.protocols import Pattern


def test_brightness_is_linear_light():
    # 188 is the sRGB value of half the light, known from the standard's own tables.
    assert drawing(Pattern("dot", brightness=0.5))["colour"] == "#bcbcbc"
    assert drawing(Pattern("dot", brightness=0.5, colour="#ff0080"))["colour"] == "#bc005c"
    assert drawing(Pattern("white", brightness=0))["colour"] == "#000000"


def test_transfer_function_and_its_inverse_agree_over_all_values():
    values = np.arange(256) / 255
    np.testing.assert_allclose(srgb_encoded(srgb_decoded(values)), values, atol=1e-12)
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(dimmed(every, 1.0), every)


@pytest.mark.parametrize(
    ("pattern", "says"),
    [
        (Pattern("dot", brightness=1.2), "isn't between 0 and 1"),
        (Pattern("dot", brightness=float("nan")), "isn't between 0 and 1"),
        (Pattern("dot", brightness=1e-6), "below the screen's first step"),
        (Pattern("dot", colour="red"), "write it as #rrggbb"),
        (Pattern("dot", size_px=0), "size above 0"),
        (Pattern("dot", x_px=float("inf")), "finite"),
        (Pattern("grid"), "a grid without points"),
        (Pattern("grid", points_px=((0, float("nan")),)), "finite"),
    ],
)
def test_pattern_that_cant_be_shown_is_refused_with_the_way_out(pattern, says):
    with pytest.raises(PanelError, match=says):
        drawing(pattern)


@pytest.mark.parametrize(("asked", "drawn"), [(0.2, 1), (1.49, 1), (1.5, 2), (2.5, 3), (7, 7)])
def test_sizes_become_whole_pixels(asked, drawn):
    assert drawing(Pattern("dot", size_px=asked))["size_px"] == drawn


def test_picture_file_is_dimmed_in_linear_light(tmp_path):
    path = tmp_path / "grey.png"
    cv2.imwrite(str(path), np.full((4, 6, 3), 255, dtype=np.uint8))
    png = Picture(Pattern("picture", picture=str(path), brightness=0.5)).png(100, 100)
    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == (4, 6, 3)
    assert np.all(pixels == 188)


@pytest.mark.parametrize("content", [None, b"", b"no image at all"])
def test_unreadable_picture_is_named_before_anything_is_shown(make_panel, tmp_path, content):
    path = tmp_path / "chart.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(PanelError, match=r"chart.png.* built-in pictures are chart, leaves"):
        make_panel().show(Pattern("picture", picture=str(path)))


@pytest.mark.parametrize("draw", [chart, leaves])
@pytest.mark.parametrize("size", [(640, 400), (401, 803), (7, 5)])
def test_built_in_pictures_fill_any_panel_and_never_change(draw, size):
    pixels = draw(*size)
    assert pixels.shape == (size[1], size[0])
    np.testing.assert_array_equal(pixels, draw(*size))
    if min(size) > 100:
        # Detail everywhere: no tile of a tenth of the panel is flat.
        step = min(size) // 10
        tiles = [
            pixels[y : y + step, x : x + step]
            for y in range(0, size[1] - step, step)
            for x in range(0, size[0] - step, step)
        ]
        assert np.mean([tile.std() > 20 for tile in tiles]) > 0.9
