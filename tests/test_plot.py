import io
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from rich.style import Style

import phasemark.render
from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Flag, Frames, PhasorImages, Renderer, Views, capture, preset
from phasemark.render.figures import (
    PAPER_CMAP,
    RANGE_COLOURS,
    draw_sigma,
    landmark_limits_m,
    range_figure,
    terminal_figure,
)

SENSOR = preset("ideal")


def range_image():
    image = np.linspace(1.0, 3.0, 256).reshape(16, 16)
    image[3:5, 4:9] = np.nan
    return image


def png_size(figure):
    """Width and height of the figure drawn as PNG, from the file's own header."""
    buffer = io.BytesIO()
    figure.savefig(buffer)
    data = buffer.getvalue()
    assert data.startswith(b"\x89PNG")
    return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])


def texts(figure):
    return {text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text"))}


def pixel_colour(figure, row, col):
    """Colour at the centre of a pixel of the first axes, as drawn, 0 … 255."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    x, y = figure.axes[0].transData.transform((col + 0.5, row + 0.5))
    drawn = np.asarray(canvas.buffer_rgba())
    return drawn[drawn.shape[0] - 1 - int(y), int(x), :3]


def test_near_is_white_far_is_black_and_between_is_blue():
    np.testing.assert_allclose(PAPER_CMAP(0.0)[:3], 1)
    np.testing.assert_allclose(PAPER_CMAP(1.0)[:3], 0)
    red, green, blue, _ = PAPER_CMAP(0.5)
    assert blue > 1.5 * green > 1.5 * red


def test_a_surface_half_way_is_blue_too_and_every_caption_says_so():
    range_m = np.array([[1.0, 1.0, 2.0, 2.0, 3.0, 3.0]])  # three surfaces, no pixel that mixes two of them
    red, _, blue = (int(c) for c in pixel_colour(range_figure(range_m), 0, 2))
    assert blue > red + 100
    root = Path(__file__).resolve().parent.parent
    tour = " ".join((root / "docs" / "tour.md").read_text(encoding="utf-8").split())
    assert RANGE_COLOURS in tour
    for page in (root / "README.md", *root.glob("docs/*.md"), *root.glob("*/**/*.j2")):
        text = " ".join(page.read_text(encoding="utf-8").replace(RANGE_COLOURS, "").split())
        assert "blue is a pixel" not in text, page.name
        assert "lies blue" not in text, page.name


def test_row_zero_is_drawn_at_the_top_and_column_zero_at_the_left():
    image = np.full((16, 16), 3.0)
    image[0, 0] = 1.0
    figure = range_figure(image)
    np.testing.assert_array_equal(pixel_colour(figure, 0, 0), 255)
    for row, col in ((0, 15), (15, 0), (15, 15)):
        np.testing.assert_array_equal(pixel_colour(figure, row, col), 0)
    left, right, bottom, top = figure.axes[0].images[0].get_extent()
    assert (left, right, bottom, top) == (0, 16, 16, 0)


def test_nothing_returned_is_hatched_and_named():
    figure = range_figure(range_image(), near_m=0.5, far_m=4.0, title="cone")
    assert {"cone", "no range", "range (m)", "u (pixel columns)", "v (pixel rows)"} <= texts(figure)
    assert figure.axes[0].patch.get_hatch()
    red, _, blue = (int(c) for c in pixel_colour(figure, 3, 5))
    assert red > blue  # the paper behind is warm, no colour of the map is
    assert "no range" not in texts(range_figure(np.ones((16, 16))))


def test_empty_and_flat_images_can_be_drawn_and_no_stack_of_images():
    for image in (np.full((16, 16), np.nan), np.full((16, 16), 2.0)):
        assert png_size(range_figure(image))[0] > 300
        assert "m" in terminal_figure(image).plain
    with pytest.raises(UsageError, match=r"must be one image, \(rows, cols\), got shape \(1, 16, 16\)"):
        range_figure(range_image()[None])


def test_images_and_frames_can_be_drawn_for_a_first_look():
    ranges = range_image()
    amplitude = np.where(np.isnan(ranges), 0.0, 0.8)
    phasor = amplitude * np.exp(1j * np.nan_to_num(ranges) / SENSOR.metres_per_radian)
    images = PhasorImages(phasor[None], amplitude[None], amplitude[None], SENSOR, Views.broadcast(1.0, np.radians(30)))
    figure = images.plot()
    assert png_size(figure)[0] > 900
    assert {"range", "amplitude", "coverage"} <= texts(figure)
    assert "view 0: D = 1.000 m, δ = 30.00°, b = 0.00°, h = 0.000 m" in texts(figure)
    with pytest.raises(UsageError, match="there is no view 1: they count from 0 to 0"):
        images.plot(1)
    assert "image 0" in texts(PhasorImages(phasor[None], amplitude[None], amplitude[None], SENSOR).plot())

    flags = np.where(np.isnan(ranges), int(Flag.NO_RETURN), 0)
    flags[0, 0] = int(Flag.MISSING | Flag.SATURATED)
    figure = Frames(ranges, amplitude * 1e4, sensor=SENSOR, flags=flags).plot()
    assert {"range", "amplitude (e-)", "flags", "valid", "no return", "saturated"} <= texts(figure)
    assert "missing" not in texts(figure)
    without = Frames(ranges, sensor=SENSOR)
    assert "amplitude (e-)" not in texts(without.plot())
    with pytest.raises(UsageError, match="there is no frame 1"):
        without.plot(0, 1)


def test_terminal_picture_draws_two_pixels_in_a_character():
    image = np.array([[1.0, 2.0], [3.0, np.nan], [1.0, 3.0]])
    text = terminal_figure(image, width=2)
    lines = text.plain.split("\n")
    assert lines[:2] == ["▀▀", "▀▀"]
    assert lines[2].endswith("1.00 … 3.00 m  █ no range")
    corner, beside, last = (span.style for span in text.spans[:3])
    assert isinstance(corner, Style)
    assert isinstance(beside, Style)
    assert isinstance(last, Style)
    assert tuple(corner.color.triplet) == (255, 255, 255)
    assert tuple(corner.bgcolor.triplet) == (0, 0, 0)
    assert beside.color.triplet.blue > beside.color.triplet.red
    assert beside.bgcolor.triplet.red > beside.bgcolor.triplet.blue  # no range: warm
    assert last.bgcolor is None  # an odd row count leaves the last half line as it is


def test_terminal_picture_fills_the_width_by_whole_pixels():
    lines = terminal_figure(range_image(), width=40).plain.split("\n")
    assert {len(line) for line in lines[:-1]} == {32}
    assert len(lines) == 17
    stream = io.StringIO()
    Console(file=stream, force_terminal=True, color_system="truecolor", width=80).print(terminal_figure(range_image()))
    assert "\x1b[38;2;255;255;255" in stream.getvalue()


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        getattr(phasemark.render, "nonsense")  # noqa: B009


def test_the_colours_of_an_image_and_of_a_frame_span_the_landmark_and_not_the_wall_behind_it():
    sensor = preset("pmd-16x16")
    image = Renderer(build_mesh(catalog()["cone"]), sensor).render(1.0, 0.5, background=Background(wall_m=3.0))
    near, far = landmark_limits_m(image.range_m[0], image.coverage[0])
    whole = image.range_m[0][image.coverage[0] > 0.999]
    assert 0.8 < near < 0.95
    assert far < 1.1
    shown = (whole - near) / (far - near)
    assert np.quantile(shown, 0.75) - np.quantile(shown, 0.25) > 0.25  # the landmark is not one flat colour
    axes = image.plot().axes[0]
    assert axes.images[0].get_clim() == (near, far)
    assert axes.images[0].colorbar.extend in ("max", "both")
    frames = capture(image, sensor, rng=np.random.default_rng(3), n_frames=2)
    for coverage in (image.coverage[0], None):
        near, far = frames.plot(0, 1, coverage=coverage).axes[0].images[0].get_clim()
        assert 0.75 < near < 0.95
        assert 1.0 < far < 1.3  # the wall stands at 3 m


def test_residuals_in_sigma_have_one_scale():
    axes = Figure().add_subplot()
    image = draw_sigma(axes, np.array([[0.1, -0.2], [0.3, np.nan]]))
    assert image.get_clim() == (-5, 5)
    assert draw_sigma(Figure().add_subplot(), np.array([[7.0, -0.2]])).colorbar.extend == "max"


def test_without_anything_beside_it_no_part_of_the_landmark_is_beyond_the_colours():
    for name in ("cone", "cylinder"):
        for distance in (1.0, 1.5):
            image = Renderer(build_mesh(catalog()[name]), preset("pmd-16x16")).render(distance, 0.5)
            near, far = landmark_limits_m(image.range_m[0], image.coverage[0])
            seen = image.range_m[0][np.isfinite(image.range_m[0])]
            assert (near, far) == (seen.min(), seen.max())
    noisy = image.range_m[0].copy()
    noisy[np.unravel_index(np.nanargmax(noisy), noisy.shape)] = 9.0  # one weak pixel
    assert landmark_limits_m(noisy, image.coverage[0])[1] < far
    assert landmark_limits_m(np.full((2, 2), 1.0), np.zeros((2, 2))) == (None, None)
    assert landmark_limits_m(np.full((2, 2), np.nan), np.ones((2, 2))) == (None, None)
    near, far = landmark_limits_m(np.full((2, 2), 1.0), np.ones((2, 2)))
    assert far - near == pytest.approx(0.02)
