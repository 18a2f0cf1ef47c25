"""Road maps and animations."""

from io import StringIO

import jax
import numpy as np
import pytest
from matplotlib.colors import to_rgb, to_rgba
from numpy.testing import assert_allclose
from PIL import Image
from rich.console import Console

from tests.traffic.networks import evacuation
from uavmec_jax.env.fleet import make_fleet
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.reporting.animation import save_animation
from uavmec_jax.reporting.canvas import literal, new_figure, save
from uavmec_jax.reporting.evacuation import evacuation_data, evacuation_lines, evacuation_table
from uavmec_jax.reporting.road_map import COLOURS, LIMITS, colours_of, draw_roads, map_figure
from uavmec_jax.scenarios.places import on_place
from uavmec_jax.traffic.evacuation import load_evacuation


def lightness(colour):
    """How light a colour is in grey, from 0 to 1."""
    return float(np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722)))


def test_seven_colours_that_get_darker():
    assert colours_of(np.array([0.0, *LIMITS])) == list(COLOURS)
    assert colours_of(np.array([1.99, 59.9])) == [COLOURS[0], COLOURS[5]]
    steps = -np.diff([lightness(colour) for colour in COLOURS])
    assert (steps > 0.04).all()


def test_the_densest_roads_are_drawn_on_top_in_their_colours():
    axis = new_figure(3, 3).subplots()
    lines = draw_roads(axis, evacuation(), np.array([70.0, 3.0]))
    assert_allclose(lines.get_colors(), [to_rgba(COLOURS[1]), to_rgba(COLOURS[6])])
    assert_allclose(lines.get_segments()[1], [[0, 0], [100, 0]])  # from the corner where the UAV starts


def test_map_of_a_shipped_place(tmp_path):
    figure = map_figure(load_evacuation("round_lake"))
    texts = {text.get_text() for text in figure.axes[0].texts}
    assert {str(number) for number in range(1, 13)} <= texts
    save(figure, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 20_000


def test_dollars_and_brackets_of_a_description_are_drawn_and_printed_as_they_are(tmp_path):
    text = r"costs $x^{$ and $\frac$ [/bold] [link=https://x.y]:smile:"
    place = evacuation()
    place.meta.update(description=text, names=["[red]a[/red]", "[/]", "[bold"])
    figure = map_figure(place)
    assert figure.get_supxlabel() == text.replace("$", r"\$")
    save(figure, tmp_path / "map.svg")  # a formula would be a ValueError, a part of one a line of paths
    console = Console(record=True, width=200, file=StringIO())
    console.print(evacuation_table(place))
    printed = console.export_text()
    assert all(name in printed for name in place.meta["names"])


def test_literal_text_is_what_matplotlib_draws():
    canvas = new_figure(1, 1)
    for text in ("$", "$$", "$a$ $", r"\$5\$", r"a\b$c", ""):
        drawn, is_formula = canvas.text(0, 0, literal(text))._preprocess_math(literal(text))
        assert (drawn, is_formula) == (text, False)


def test_lines_and_data():
    lines = evacuation_lines(evacuation())
    assert any("1 had not left" in line for line in lines)
    assert any(line.startswith("1 residential roads have no way") for line in lines)
    assert lines[-1] == "Warning: 5% of the vehicles had not left at the end; simulate longer."
    data = evacuation_data(evacuation())
    assert [device["high_traffic"] for device in data["devices"]] == [True, True, False]
    assert data["devices"][1]["window_weight"] == [0.2, 0.4]


@pytest.mark.slow
def test_animation_has_a_frame_for_each_slot(tmp_path):
    place, params = evacuation(), Params(n_devices=3)
    layout = on_place(sample_layout(jax.random.key(0), params, 1, 1), place, moving=True)
    path = tmp_path / "evacuation.gif"
    slots = save_animation(path, place, params, layout, HEURISTICS["oldest-first"], jax.random.key(1), "hamlet")
    assert slots >= 10
    with Image.open(path) as image:
        assert image.is_animated
        assert image.n_frames <= slots  # equal frames are kept as one
        durations, colours = 0, set()
        for frame in range(image.n_frames):
            image.seek(frame)
            durations += image.info["duration"]
            pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
            colours |= {tuple(pixel) for pixel in np.unique(pixels, axis=0).tolist()}
        assert durations == 500 * slots + 2000  # the last frame is held
    # one palette for all frames, in which every class of traffic has a colour of its own
    assert len(colours) <= 256
    for colour in COLOURS:
        assert tuple(round(255 * channel) for channel in to_rgb(colour)) in colours
    assert [file.name for file in tmp_path.iterdir()] == ["evacuation.gif"]


@pytest.mark.slow
def test_animation_of_a_fleet(tmp_path):
    place, params = evacuation(), Params(n_devices=3, end="horizon", horizon_s=1200.0)
    layout = on_place(sample_layout(jax.random.key(0), params, 1, 1), place, moving=True)
    layout = layout.replace(fleet=make_fleet(params, 2))
    path = tmp_path / "evacuation.gif"
    slots = save_animation(path, place, params, layout, HEURISTICS["oldest-first"], jax.random.key(1), "hamlet")
    with Image.open(path) as image:
        assert 1 < image.n_frames <= slots
