"""`design`: predicted crosstalk of real cameras under LEDs, the best set of lamps, and what cannot be told apart."""

from __future__ import annotations

import numpy as np
import pytest

from rgbmidic.errors import CalibrationError, ConfigurationError, InputError
from rgbmidic.tools.scene.camera import MEASURED_CROSSTALK
from rgbmidic.tools.scene.spectra import HALF_MAXIMUM, Led, Sensitivities
from rgbmidic_calibration.design import MeasuredLamp, best_sets, design, read_camera, read_lamp
from rgbmidic_calibration.pictures import draw_design

LEDS = {"red": Led(centre=630, width=18), "green": Led(centre=525, width=30), "blue": Led(centre=465, width=20)}
OHNO = {name: Led(centre=lamp.centre, width=HALF_MAXIMUM * lamp.width) for name, lamp in LEDS.items()}
"""Lamps whose parameter in Ohno's model, as colour-science takes it, is 18, 30 and 20 nm."""
LOWEST, HIGHEST = 1.55, 3.55
"""Condition numbers of the nine shared cameras under LEDs of equal peak power, rows divided by the diagonal."""


def boxes():
    """A camera whose channels are boxes 600-700, 500-600, 400-500 nm."""
    wavelengths = np.arange(380, 781, 5.0)
    edges = ((600, 700), (500, 600), (400, 500))
    return Sensitivities(
        wavelengths=wavelengths,
        values=np.array([(wavelengths >= a) & (wavelengths < b) for a, b in edges], dtype=float),
    )


def test_lamps_inside_the_boxes_have_no_crosstalk():
    lamps = {name: Led(centre=centre, width=15) for name, centre in (("red", 650), ("green", 550), ("blue", 450))}
    prediction = design(boxes(), lamps)
    assert prediction.crosstalk.matrix == pytest.approx(np.eye(3), abs=0.01)
    assert prediction.crosstalk.condition_number == pytest.approx(1, abs=0.02)
    assert prediction.power == pytest.approx(np.ones(3), abs=0.02)
    assert prediction.headroom == pytest.approx(1, abs=0.02)


def test_lamp_on_the_border_of_two_boxes_is_shared():
    prediction = design(boxes(), {"red": Led(centre=650, width=5), "amber": Led(centre=597.5, width=5)})
    assert prediction.crosstalk.matrix[:2, 1] == pytest.approx(1, abs=0.02)
    assert prediction.headroom == pytest.approx(0.5, abs=0.01)


def test_best_set_of_candidates():
    lamps = {**LEDS, "amber": Led(centre=595, width=18), "cyan": Led(centre=500, width=30)}
    prediction = best_sets(boxes(), lamps)
    assert 6 <= len(prediction) <= 10
    assert set(prediction[0].crosstalk.lights) == {"red", "green", "blue"}
    assert [candidate.noise for candidate in prediction] == sorted(candidate.noise for candidate in prediction)


def test_what_cannot_be_told_apart():
    twins = {"one": Led(centre=640, width=18), "two": Led(centre=641, width=18)}
    with pytest.raises(CalibrationError, match="no set of these lamps"):
        best_sets(boxes(), twins, 2)
    with pytest.raises(CalibrationError, match="does not see infrared"):
        design(boxes(), {"infrared": Led(centre=760, width=5)})
    with pytest.raises(CalibrationError, match="cannot choose 3 of 2"):
        best_sets(boxes(), twins, 3)


def test_lamps_and_cameras_from_text(tmp_path):
    assert read_lamp("630:18") == LEDS["red"]
    assert read_lamp("525").width == 25
    (tmp_path / "lamp.csv").write_text("nm,a,b\n400,0,1\n500,1,1\n600,0,1\n")
    one, other = (read_lamp(str(tmp_path / "lamp.csv") + column) for column in ("", "#b"))
    wavelengths = np.arange(400, 601, 50.0)
    assert one.power(wavelengths) == pytest.approx(np.array([0, 0.5, 1, 0.5, 0]) / 2)
    assert other.power(wavelengths) == pytest.approx(np.full(5, 0.2))
    (tmp_path / "camera.csv").write_text("nm,x R,x G,x B\n400,0,0,1\n500,0,1,-1e-19\n600,1,0,0\n")
    assert read_camera(f"{tmp_path / 'camera.csv'}#x").values.min() == 0
    np.savetxt(tmp_path / "plain.csv", np.array([[400, 0, 0, 1], [500, 0, 1, 0], [600, 1, 0, 0]]), delimiter=",")
    assert len(read_camera(str(tmp_path / "plain.csv")).wavelengths) == 3  # 4.0e+02 is no heading


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("nothing.csv", ConfigurationError, "file of spectra not found"),
        ("5000:10", InputError, "200 to 1200 nm"),
        ("lava lamp", ConfigurationError, "a lamp is CENTRE:WIDTH"),
    ],
)
def test_lamps_that_are_none(text, error, message):
    with pytest.raises(error, match=message):
        read_lamp(text)


def test_tables_that_are_none(tmp_path):
    (tmp_path / "bad.csv").write_text("nm,a\n400,x\n")
    with pytest.raises(ConfigurationError, match="not a table of numbers"):
        read_lamp(str(tmp_path / "bad.csv"))
    (tmp_path / "good.csv").write_text("nm,a\n400,1\n500,1\n")
    with pytest.raises(ConfigurationError, match="has no column c; it has a"):
        read_lamp(f"{tmp_path / 'good.csv'}#c")
    with pytest.raises(InputError, match="rising wavelengths"):
        MeasuredLamp(wavelengths=np.array([2.0, 1.0]), values=np.ones(2))


def test_picture(tmp_path):
    draw_design(design(boxes(), LEDS), boxes(), LEDS, tmp_path / "d.png")
    assert (tmp_path / "d.png").stat().st_size > 10_000


@pytest.mark.parametrize("width", [12.0, 20.0, 35.0])
def test_width_of_an_led_is_its_full_width_at_half_maximum(width):
    wavelengths = np.arange(380, 881, 0.01)
    power = read_lamp(f"630:{width}").power(wavelengths)
    above = wavelengths[power >= power.max() / 2]
    assert np.ptp(above) == pytest.approx(width, abs=0.03)


def rows_by_diagonal(camera):
    """Matrix for LEDs of equal peak power with every row divided by its diagonal."""
    prediction = design(camera, OHNO)
    peak = np.array([1 / lamp.power(camera.wavelengths).max() for lamp in OHNO.values()])
    response = prediction.crosstalk.matrix / prediction.power * peak
    return response / np.diag(response)[:, None]


def test_measured_crosstalk_of_the_scenes_is_that_of_the_camera_and_lamps_it_names():
    prediction = design(read_camera("Nikon 5100 (NPL)"), LEDS)
    np.testing.assert_allclose(prediction.crosstalk.matrix, MEASURED_CROSSTALK, atol=0.005)
    assert prediction.crosstalk.noise_amplification == pytest.approx([1.01, 1.18, 1.15], abs=0.005)


@pytest.mark.parametrize(("width", "moved"), [(15.0, 0.05), (25.0, 0.02), (35.0, 0.04)])
def test_widths_of_data_sheets_move_the_crosstalk_by_some_hundredths(width, moved):
    camera = read_camera("Nikon 5100 (NPL)")
    lamps = {name: Led(centre=lamp.centre, width=width) for name, lamp in LEDS.items()}
    difference = design(camera, lamps).crosstalk.matrix - design(camera, LEDS).crosstalk.matrix
    assert 0.5 * moved < np.abs(difference).max() < 1.5 * moved


def test_nine_real_cameras(real_data):
    files = sorted(real_data("camera_sensitivities").glob("*.json"))
    assert len(files) == 9
    for file in files:
        camera = read_camera(str(file))
        assert LOWEST < np.linalg.cond(rows_by_diagonal(camera)) < HIGHEST
        prediction = design(camera, LEDS).crosstalk
        assert 1.5 < prediction.condition_number < 2.6
        assert (prediction.matrix.argmax(axis=0) == [0, 1, 2]).all()


def test_nikon_5100_of_two_sources(real_data):
    expected = [[1, 0.27, 0.09], [0.04, 1, 0.24], [0, 0.39, 1]]  # of lamps whose parameter is 18, 30, 20 nm
    from_json = read_camera(str(real_data("camera_sensitivities") / "nikon_d5100_380_780_5.json"))
    table = real_data("led_and_camera_spectra") / "colour_science_0.4.7_spectra.csv"
    from_csv = read_camera(f"{table}#Nikon 5100 (NPL)")
    for camera in (from_json, from_csv):
        assert rows_by_diagonal(camera) == pytest.approx(np.array(expected), abs=0.01)
    model = read_lamp(f"{table}#Ohno2005_red_630_18").power(from_csv.wavelengths)  # 18 is the model's parameter
    assert model == pytest.approx(OHNO["red"].power(from_csv.wavelengths), abs=1e-4)
