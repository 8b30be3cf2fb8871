"""Draws the figures of the pages as SVG, each for a light and a dark background, and takes the viewer's pictures.

    python docs/figures.py [NAME ...] [--demo FOLDER]

What shows a measurement comes from the demo's own files (``rgbmidic demo`` makes them, in FOLDER if it is not there).
The pictures of the viewer need chromium and chromium-driver, and show the path of FOLDER: choose one like /data/demo.
"""

from __future__ import annotations

import argparse
import io
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle, Wedge

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
LAMPS = {"red": "#d4553a", "green": "#3d9950", "blue": "#3b76c4"}
THEMES = {"light": ("#1f2328", "#8a9199", "#ffffff"), "dark": ("#e6e9ec", "#8a9199", "#14181e")}
"""Ink, faint ink and paper of pydata's two themes."""
plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "rgbmidic", "font.family": "sans-serif", "font.size": 10})


class Sheet:
    """Axes without a frame, and pencils in the colours of a theme."""

    def __init__(self, theme: str, width: float, height: float, *, metres: tuple[float, float]) -> None:
        self.ink, self.faint, self.paper = THEMES[theme]
        self.figure, self.axis = plt.subplots(figsize=(width, height))
        self.axis.set(xlim=(0, metres[0]), ylim=(0, metres[1]), aspect="equal")
        self.axis.axis("off")
        self.figure.subplots_adjust(0, 0, 1, 1)

    def text(self, x: float, y: float, words: str, **options: Any) -> None:
        options = {"color": self.ink, "ha": "center", "va": "center", **options}
        self.axis.text(x, y, words, **options)

    def arrow(self, begin: tuple[float, float], end: tuple[float, float], **options: Any) -> None:
        options = {"color": self.ink, "arrowstyle": "-|>", "mutation_scale": 11, "lw": 1.2, **options}
        self.axis.add_patch(FancyArrowPatch(begin, end, shrinkA=0, shrinkB=0, **options))

    def box(self, x: float, y: float, width: float, height: float, words: str, **options: Any) -> None:
        """Box with its lower left corner at (x, y) and words in its middle."""
        shape = {"boxstyle": "round,pad=0,rounding_size=0.12", "fc": "none", "ec": self.ink, "lw": 1.1}
        self.axis.add_patch(FancyBboxPatch((x, y), width, height, **{**shape, **options}))
        self.text(x + width / 2, y + height / 2, words, linespacing=1.35)


def set_up(theme: str) -> None:
    """Lamps, camera and specimen: every lamp reflects elsewhere."""
    s = Sheet(theme, 7.2, 3.4, metres=(7.2, 3.4))
    s.axis.add_patch(Wedge((5.75, 1.7), 1.25, 118, 242, width=0.16, fc=s.faint, ec=s.ink, lw=1))
    s.text(5.75, 0.3, "specimen, speckled:\neach lamp reflects elsewhere")
    s.axis.add_patch(Rectangle((0.35, 1.42), 0.75, 0.56, fc="none", ec=s.ink, lw=1.3))
    s.axis.add_patch(Polygon([(1.1, 1.55), (1.35, 1.45), (1.35, 1.95), (1.1, 1.85)], fc="none", ec=s.ink, lw=1.3))
    s.text(0.75, 1.06, "colour camera,\none raw frame\nper state", va="top")
    for (name, colour), place, spot in zip(
        LAMPS.items(), [(2.6, 3.1), (2.6, 2.35), (2.6, 0.4)], [(4.82, 2.5), (4.53, 1.95), (4.68, 1.05)], strict=True
    ):
        s.axis.add_patch(Polygon([place, (5.08, 2.76), (4.5, 1.7), (5.08, 0.64)], fc=colour, alpha=0.13, ec="none"))
        s.arrow(place, spot, color=colour, arrowstyle="-", lw=1.1)
        s.arrow(spot, (1.42, 1.7), color=colour, lw=1.1, linestyle=(0, (4, 2)))
        s.axis.add_patch(Circle(place, 0.15, fc=colour, ec="none"))
        s.axis.add_patch(Circle(spot, 0.09, fc=colour, ec=s.ink, lw=0.6))
        s.text(place[0] - 0.28, place[1], f"{name} lamp", color=colour, ha="right")
    save(s.figure, "set_up", theme)


def way(theme: str) -> None:
    """From a raw frame to displacement, strain and rates."""
    s = Sheet(theme, 7.2, 2.9, metres=(7.2, 2.9))
    rows = [
        ["raw frame\n(Bayer mosaic)", "linearise", "demosaic and\nunmix crosstalk", "one image\nper light"],
        [
            "strain, rates,\nprobes",
            "displacement and\nits uncertainty",
            "one MIDIC solve,\nall lights at once",
            "weights: where\neach light counts",
        ],
    ]  # fmt: skip
    width, height, step = 1.48, 0.78, 1.86
    for row, (names, y) in enumerate(zip(rows, (1.85, 0.3), strict=True)):
        for i, name in enumerate(names):
            s.box(0.12 + i * step, y, width, height, name, ec=s.ink if (row, i) != (1, 2) else LAMPS["green"], lw=1.1)
        for i in range(3):
            ends = [(0.12 + width + i * step, y + height / 2), (0.12 + (i + 1) * step, y + height / 2)]
            s.arrow(*(ends if row == 0 else ends[::-1]))
    x = 0.12 + 3 * step + width / 2
    s.arrow((x, 1.85), (x, 0.3 + height))
    for i, colour in enumerate(LAMPS.values()):
        s.axis.add_patch(Rectangle((x - 0.62 + 0.44 * i, 1.74), 0.36, 0.06, fc=colour))
    s.text(
        0.12 + 1.5 * step, 1.46, "calibrated once: black level, noise, crosstalk matrix, registration", color=s.faint
    )
    save(s.figure, "way", theme)


def house(theme: str) -> None:
    """The rooms of the package in the order that lint-imports holds, from pyproject.toml."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        contract = tomllib.load(file)["tool"]["importlinter"]["contracts"][0]
    kept = [name.removeprefix("rgbmidic.") for layer in contract["layers"] for name in layer.split(" | ")]
    kept = ["cli", *(name for name in kept if not name.startswith("cli."))]
    floors = [
        ("the commands", ["cli", "rgbmidic_calibration"]),
        ("tools", [f"tools.{name}" for name in ("scene", "lab", "view", "report", "finite_elements", "stereo")]),
        ("a test", ["pipeline"]),
        ("results", ["results"]),
        ("one frame", ["weights", "fields", "correlation", "illumination"]),
        ("what it works on", ["frames", "mesh"]),
        ("compiled", ["_kernels"]),
        ("what all know", ["settings", "errors", "typing"]),
    ]
    drawn = [name for _, names in floors for name in names]
    missing = {name for name in kept if (ROOT / "rgbmidic" / name.replace(".", "/")).is_dir()} - set(drawn)
    assert not missing, f"rooms of pyproject.toml that the house does not show: {missing}"
    assert set(drawn) <= set(kept)
    tall = 0.5
    s = Sheet(theme, 7.2, 4.6, metres=(7.2, 4.6))
    for i, (floor, names) in enumerate(floors):
        y = 4.0 - i * (tall + 0.06)
        width = 5.3 / len(names)
        for j, name in enumerate(names):
            about = {"fc": LAMPS["green"] + "30", "ec": s.ink, "lw": 0.9} if name == "correlation" else {"lw": 0.9}
            s.box(
                1.45 + j * width,
                y,
                width - 0.08,
                tall,
                name.removeprefix("tools.").replace("finite_", "finite\n"),
                **about,
            )
        s.text(1.3, y + tall / 2, floor, ha="right", color=s.faint)
    s.arrow((6.85, 4.4), (6.85, 0.15), color=s.faint)
    s.text(7.02, 2.3, "imports go down only", rotation=90, color=s.faint, fontsize=8)
    save(s.figure, "house", theme)


class Demo:
    """What the demo measured: images of its lights, result, exact truth; red alone beside it."""

    def __init__(self, folder: Path) -> None:
        from rgbmidic import Calibration, Result, correlate, read_frame, read_test
        from rgbmidic.illumination import separate

        settings = read_test(folder / "test" / "test.toml")
        calibration = Calibration.read(folder / "test" / "calibration.json")
        files = sorted((folder / "test" / "frames").glob("*.dng"))
        self.raw = read_frame(files[-1])
        self.before, self.after = (
            separate(read_frame(file), calibration).on_first_light().values for file in (files[0], files[-1])
        )
        self.result = Result.open(folder / "result")
        options = {"region": settings.region.rectangle, "element_size": settings.mesh.element_size}
        self.alone = correlate(self.before[0], self.after[0], **options)
        with np.load(folder / "test" / "truth.npz") as archive:
            self.truth = archive["displacement"][-1]

    def error(self, displacement: Any) -> Any:
        """Length of the error at each node, px."""
        from rgbmidic.fields import at_nodes

        return np.hypot(*(displacement - at_nodes(self.truth, self.result.nodes)).T)


@cache
def droplets() -> tuple[Any, Any, list[Any]]:
    """The bench with raised droplets turned by 8 degrees: green's image, truth, solutions by green alone and by all."""
    sys.path.append(str(ROOT / "examples" / "paper"))
    from bench import Bench
    from rgbmidic import correlate, measure_sequence

    bench = Bench.build("bayer", 640)
    clean = [bench.render(angle) for angle in (0.0, 8.0)]
    gain = bench.exposure_gain(max(bench.brightest(images) for images in clean))
    first, second = (bench.photograph(images * gain, shot, "auto") for shot, images in enumerate(clean))
    alone = correlate(first.values[1], second.values[1], region=bench.region)
    (together,) = measure_sequence([second], reference=first, region=bench.region)  # with the lights' registration
    return second.values[1], bench.truth(8.0), [alone, together]


def reflection(theme: str, demo: Demo) -> None:
    """The green light's image, where it reflects on raised droplets; the error of it alone and of three lights."""
    from rgbmidic import Tri3Mesh
    from rgbmidic.fields import at_nodes, field_rms

    ink = THEMES[theme][0]
    figure, axes = plt.subplots(1, 3, figsize=(7.2, 2.75), gridspec_kw={"wspace": 0.06})
    image, truth, solutions = droplets()
    titles = ["the green lamp's image", "error, this lamp alone", "error, three lamps, one frame"]
    corners = (-0.5, len(image) - 0.5, len(image) - 0.5, -0.5)
    axes[0].imshow(image[::2, ::2], cmap="gray", extent=corners, vmax=np.quantile(image, 0.995))
    for axis, found in zip(axes[1:], solutions, strict=True):
        error = np.hypot(*(found.displacement - at_nodes(truth, found.nodes)).T)
        drawn = axis.tripcolor(
            *found.nodes.T,
            found.elements,
            np.nan_to_num(error, nan=1.0),
            shading="gouraud",
            vmin=0,
            vmax=0.06,
            cmap="magma",
            rasterized=True,
        )
        rms = field_rms(Tri3Mesh(nodes=found.nodes, elements=found.elements), found.displacement, truth)
        axis.text(320, 646, f"rms {rms:.4f} px", ha="center", va="top", color=ink)
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, color=ink, fontsize=9)
        axis.set(xlim=(10, 629), ylim=(629, 10), aspect="equal")
        axis.axis("off")
    figure.subplots_adjust(0.01, 0.06, 0.88, 0.92)
    bar = figure.colorbar(drawn, cax=figure.add_axes((0.89, 0.16, 0.015, 0.66)))
    bar.set_label("px", color=ink)
    bar.ax.tick_params(colors=ink)
    save(figure, "reflection", theme)


def match(theme: str, demo: Demo) -> None:
    """Grey levels along one row, reference and deformed image warped by the true motion, in and beside a reflection."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    ink, faint, _ = THEMES[theme]
    rows, columns = np.mgrid[:448, :448].astype(float)
    places = rows + demo.truth[1], columns + demo.truth[0]
    # divided by their local mean (sigma 10 px), which takes out shading
    before, after = (images / gaussian_filter(images, (0, 10, 10)) for images in (demo.before, demo.after))
    warped = np.stack([map_coordinates(image, places, order=3, mode="nearest") for image in after])
    # where red errs most against blue, over the stretch that is drawn
    lost = gaussian_filter(np.abs(warped[0] - before[0]) - np.abs(warped[2] - before[2]), (2, 30))[60:-60, 90:-90]
    row, middle = np.add(np.unravel_index(np.argmax(lost), lost.shape), (60, 90))
    part = slice(middle - 60, middle + 61)
    figure, axes = plt.subplots(2, 1, figsize=(7.2, 3.4), sharex=True, gridspec_kw={"hspace": 0.32})
    for axis, light, words in zip(
        axes, (0, 2), ("red reflects here: its texture changes", "blue, the same place: it stays"), strict=True
    ):
        name = list(LAMPS)[light]
        axis.plot(range(part.start, part.stop), before[light, row, part], color=faint, lw=2, label="reference")
        after_turn = {"color": LAMPS[name], "lw": 1.2, "label": "after the turn, warped by the true motion"}
        axis.plot(range(part.start, part.stop), warped[light, row, part], **after_turn)
        axis.set_title(words, color=ink, fontsize=9, loc="left")
        axis.legend(frameon=False, fontsize=8, labelcolor=ink, loc="lower right", ncols=2, bbox_to_anchor=(1, 0.97))
        axis.tick_params(colors=ink)
        axis.set_ylabel("over local mean", color=ink)
        for side in axis.spines.values():
            side.set_color(faint)
    axes[1].set_xlabel("x, px", color=ink)
    figure.subplots_adjust(0.1, 0.13, 0.98, 0.93)
    save(figure, "match", theme)


def weights(theme: str, demo: Demo) -> None:
    """Mesh over the raw frame, and how much each light counts at each node."""
    ink = THEMES[theme][0]
    figure, axes = plt.subplots(1, 4, figsize=(7.2, 2.2), gridspec_kw={"wspace": 0.05})
    axes[0].imshow(demo.raw.values[::2, ::2], cmap="gray", extent=(-0.5, 447.5, 447.5, -0.5))
    axes[0].triplot(*demo.result.nodes.T, demo.result.elements, color="#f2c037", lw=0.4)
    axes[0].set_title("mesh on the raw frame", color=ink, fontsize=9)
    fractions = demo.result.light_fraction[-1].T
    for light, (axis, name) in enumerate(zip(axes[1:], LAMPS, strict=True)):
        drawn = axis.tripcolor(
            *demo.result.nodes.T,
            demo.result.elements,
            fractions[light],
            shading="gouraud",
            vmin=0,
            vmax=0.8,
            cmap="viridis",
            rasterized=True,
        )
        axis.set_title(f"fraction of {name}", color=ink, fontsize=9)
    for axis in axes:
        axis.set(xlim=(20, 427), ylim=(440, 8), aspect="equal")
        axis.axis("off")
    figure.subplots_adjust(0.01, 0.02, 0.92, 0.9)
    bar = figure.colorbar(drawn, cax=figure.add_axes((0.93, 0.12, 0.012, 0.7)))
    bar.ax.tick_params(colors=ink)
    save(figure, "weights", theme)


def save(figure: Any, name: str, theme: str) -> None:
    """Write docs/images/NAME_THEME.svg without a date, so that drawing twice gives the same file."""
    IMAGES.mkdir(exist_ok=True)
    figure.savefig(IMAGES / f"{name}_{theme}.svg", transparent=True, metadata={"Date": None})
    plt.close(figure)


PICTURES = {
    "plan": "plan/plan.png",
    "inspection": "inspected/inspection.png",
    "fractions": "result/figures/fractions_000013.png",
    "displacement": "result/figures/displacement_000013.png",
    "history": "history.png",
}
"""Pictures of the tutorial, and what its commands call them."""


def tutorial() -> None:
    """Run the commands of the tutorial as written, and keep the pictures that they make, 800 px wide at most."""
    import cv2

    page = ROOT / "docs" / "tutorials" / "impact.md"
    text = page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        shutil.copy(ROOT / "examples" / "scenes" / "impact.toml", folder)
        marked = r"(?:^<!-- file: (\S+) -->\n)?^```(?:bash|toml)\n(.*?)^```"
        for name, block in re.findall(marked, text, flags=re.DOTALL | re.MULTILINE):
            if name:
                (folder / name).write_text(block, encoding="utf-8")
            else:
                subprocess.run(["bash", "-ec", block], cwd=folder, check=True)
        for name, source in PICTURES.items():
            picture = cv2.imread(str(folder / source))
            assert picture is not None
            width = min(picture.shape[1], 800)
            small = cv2.resize(
                picture, (width, picture.shape[0] * width // picture.shape[1]), interpolation=cv2.INTER_AREA
            )
            cv2.imwrite(str(page.parent / "images" / f"{name}.png"), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def viewer(demo: Path) -> None:
    """Open the demo's result and its test in a browser, and keep docs/images/view_*.png of both."""
    sys.path.insert(0, str(ROOT / "tests"))
    from PIL import Image
    from viewer import Page, chromium, click, serving

    def keep(name: str) -> None:
        picture = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
        picture.quantize(256, dither=Image.Dither.NONE).save(IMAGES / f"view_{name}.png", optimize=True)

    marks = "marks=point:140,140;strain_gauge:170,330;line:60,220;line:380,220"
    with chromium() as driver:
        driver.set_window_size(1280, 940)
        with serving(demo / "result") as address:
            page = Page(driver, f"{address}?field=exx&theme=light&{marks}")
            page.until("model('lines').data.xs.length && model('probes').data.text.length === 3")
            page.until("!model('head').text.includes('looked through')")
            keep("result")
        with serving(demo / "test" / "test.toml") as address:
            page = Page(driver, f"{address}?theme=light")
            driver.execute_script(*click("Inspect"))
            page.until("model('plot').title.text.startsWith('expected uncertainty') && model('tiles').text")
            keep("setup")


SKETCHES: dict[str, Callable[[str], None]] = {"set_up": set_up, "way": way, "house": house}
MEASURED: dict[str, Callable[[str, Demo], None]] = {"reflection": reflection, "match": match, "weights": weights}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join([*SKETCHES, *MEASURED])}, tutorial, viewer; none: all"
    )
    parser.add_argument("--demo", type=Path, default=Path("rgbmidic-demo"), metavar="FOLDER")
    arguments = parser.parse_args()
    every = [*SKETCHES, *MEASURED, "tutorial", "viewer"]
    names = arguments.names or every
    if unknown := set(names) - {*every}:
        parser.error(f"unknown: {', '.join(unknown)}; allowed are {', '.join(every)}")
    if "tutorial" in names:
        tutorial()
        names = [name for name in names if name != "tutorial"]
    measured = [name for name in names if name in MEASURED]
    if (measured or "viewer" in names) and not arguments.demo.is_dir():
        subprocess.run(["rgbmidic", "demo", "--out", str(arguments.demo)], check=True)
    if "viewer" in names:
        viewer(arguments.demo.resolve())
        names = [name for name in names if name != "viewer"]
    if measured:
        demo = Demo(arguments.demo)
    for theme in THEMES:
        for name in names:
            MEASURED[name](theme, demo) if name in measured else SKETCHES[name](theme)


if __name__ == "__main__":
    main()
