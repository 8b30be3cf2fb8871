"""Cut the crops of this folder out of the full files: python tests/data/make.py FOLDER_OF_THE_FULL_FILES.

Only files whose licence allows it are here (LICENCES.txt); every folder has a SOURCE.txt with the address, commit and
SHA-256 of what it was cut from. Formats stay what they are: headers and samples are the camera's, only fewer.
"""

from __future__ import annotations

import re
import shutil
import struct
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import tifffile

HERE = Path(__file__).parent
ACTIVE_AREA, BYTE_COUNTS, HEIGHT, WIDTH, ROWS = 50829, 279, 257, 256, 278
"""Tags of TIFF and DNG."""
GOLD_ROWS = 16
"""Of the decoded frames that DICe gives as float64."""
WANTED = {
    "raw_must_reject": ("sample_1mp.dng", "dng_with_preview.dng"),
    "dic_challenge_sample14": (
        "command.csv",
        "Sample14 Reference.tif",
        "Sample14 L3 Amp0.1b.tif",
        "Sample14 L5 Amp0.1b.tif",
    ),
    "public_pairs": (
        *("s5_ref.tif", "s5_000_c75_r10.tif", "s5_001_c100_r20.tif"),
        *("pattern_7x.bmp", "pattern_7x_tension.bmp"),
    ),
    "real_disks_three_bands": (
        "disks_650nm_250ms.tif",
        "disks_550nm_25ms.tif",
        "disks_450nm_50ms.tif",
        *(f"dark_{time}ms_{number}.tif" for time in (250, 25, 50) for number in (0, 1)),
    ),
}
"""Files of a folder, where not all are used or may be given on."""
COPYRIGHT = {
    "dicengine/dice": "BSD-3-Clause, Copyright 2015 National Technology & Engineering Solutions of Sandia, LLC (NTESS)",
    "vincentjzy/OpenCorr": "MPL-2.0, Copyright Zhenyu Jiang and contributors",
    "PolymerGuy/muDIC": "MIT, Copyright (c) 2019 PolymerGuy",
    "AcademySoftwareFoundation/rawtoaces": "Apache-2.0, Copyright Contributors to the rawtoaces Project",
    "mushfiqulalam/isp": "MIT, Copyright (c) 2017 Mushfiqul Alam",
    "ladisk/pyMRAW": "MIT, Copyright (c) 2024 LADISK",
    "ladisk/pyidi": "MIT, Copyright (c) 2018 - 2019 Domen Gorjup, Janko Slavič, Klemen Zaletelj (in alphabetic order)",
    "syoyo/tinydngloader": "MIT (stated in its README), by Syoyo Fujita",
    "bllanos/chromatic-aberration": "BSL-1.0, by Bernard Llanos, University of Alberta (its README)",
    "LineageOS/android_external_skia": "BSD-3-Clause, Copyright 2011 Google Inc., Copyright 2017 Google LLC",
}
NAMED = {"led_and_camera_spectra": ["BSD-3-Clause, Copyright 2013 Colour Developers"]}
"""Holder of a folder whose SOURCE.txt lists no files."""


def crop_tiff(file: Path, out: Path, window: list[int]) -> None:
    """The same pixels and the same palette, compressed without loss."""
    left, top, right, bottom = window
    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages.first
        values, colours = page.asarray()[top:bottom, left:right], page.colormap
    kind = {"photometric": "minisblack"} if colours is None else {"photometric": "palette", "colormap": colours}
    tifffile.imwrite(out, values, compression="zlib", predictor=colours is None, metadata=None, **kind)


def crop_scene(scene: Path, out: Path, window: list[int], frames: list[int]) -> None:
    """Frames, crosstalk, and the truth in units of 1/4096 px as steps along rows and columns; 0 for other frames."""
    left, top, right, bottom = window
    (out / "frames").mkdir(parents=True)
    for frame in frames:
        name = f"frames/frame_{frame:03d}.tif"
        crop_tiff(scene / name, out / name, window)
    np.savez(out / "lights.npz", crosstalk=np.load(scene / "lights.npz")["crosstalk"])
    truth = np.load(scene / "truth.npz")["u"][:, :, top:bottom, left:right]
    truth[[frame not in frames for frame in range(len(truth))]] = 0
    steps = np.round(truth * 2**12).astype(np.int32)
    for axis in (2, 3):
        steps = np.diff(steps, axis=axis, prepend=0)
    np.savez_compressed(out / "truth.npz", steps=steps)


def cut_cine(file: Path, out: Path, frames: int) -> None:
    """The first frames: header, set-up, time stamps and exposures of these, and their samples as they are stored."""
    content = file.read_bytes()
    count, setup, table = (struct.unpack_from("<I", content, place)[0] for place in (20, 28, 32))
    blocks, place = b"", setup + struct.unpack_from("<H", content, setup + 142)[0]
    while place < table:
        size, kind, reserved = struct.unpack_from("<IHH", content, place)
        each = (size - 8) // count * frames
        blocks += struct.pack("<IHH", 8 + each, kind, reserved) + content[place + 8 : place + 8 + each]
        place += size
    offsets = np.frombuffer(content, "<i8", count, table)
    ends = np.append(offsets[1:], len(content))[:frames]
    before = setup + struct.unpack_from("<H", content, setup + 142)[0]
    header = bytearray(content[:before])
    struct.pack_into("<I", header, 20, frames)
    struct.pack_into("<I", header, 32, before + len(blocks))
    first = before + len(blocks) + 8 * frames
    moved = offsets[:frames] - offsets[0] + first
    out.write_bytes(bytes(header) + blocks + moved.astype("<i8").tobytes() + content[offsets[0] : ends[-1]])


def cut_gold(file: Path, out: Path) -> None:
    """The first rows of a frame that DICe has decoded."""
    content = file.read_bytes()
    columns, _, depth = struct.unpack_from("<3i", content)
    out.write_bytes(struct.pack("<3i", columns, GOLD_ROWS, depth) + content[12 : 12 + 8 * columns * GOLD_ROWS])


def cut_photron(file: Path, out: Path, frames: int) -> None:
    """The first frames of a .mraw, and their number in the header, whose length stays."""
    if file.suffix == ".mraw":
        (header,) = (one.read_bytes() for one in file.parent.glob(f"{file.stem}.cih*"))
        count = int(re.search(rb"(?m)(?:^Total Frame : |<totalFrame>)(\d+)", header)[1])
        content = file.read_bytes()
        out.write_bytes(content[: len(content) // count * frames])
        return
    content = re.sub(rb"(?m)^(Total Frame : )\d+", rb"\g<1>%d" % frames, file.read_bytes())
    tag = re.search(rb"<totalFrame>\d+</totalFrame>", content)
    if tag:
        content = content.replace(tag[0], (b"<totalFrame>%d</totalFrame>" % frames).ljust(len(tag[0])))
    out.write_bytes(content)


def cut_dng(file: Path, out: Path, window: list[int]) -> None:
    """The upper left of an uncompressed DNG with its masked border: samples of 14 bits, whole bytes of every row."""
    _, _, columns, rows = window
    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages.first
        (start,), bits, width = page.dataoffsets, page.bitspersample, page.imagewidth
        active = page.tags[ACTIVE_AREA].value
    content = file.read_bytes()
    samples = np.frombuffer(content, np.uint8, offset=start).reshape(-1, width * bits // 8)
    out.write_bytes(content[:start] + samples[:rows, : columns * bits // 8].tobytes())
    with tifffile.TiffFile(out, mode="r+") as tiff:
        tags = tiff.pages.first.tags
        for code, value in ((WIDTH, columns), (HEIGHT, rows), (ROWS, rows), (BYTE_COUNTS, rows * columns * bits // 8)):
            tags[code].overwrite(value)
        tags[ACTIVE_AREA].overwrite((*active[:2], rows, columns))
        tags[50720].overwrite((columns - active[1], rows - active[0]))


def crop_raw(file: Path, out: Path, window: list[int]) -> None:
    """A window of a headerless file; its shape is in the name."""
    left, top, right, bottom = window
    columns, rows = map(int, re.search(r"(\d+)x(\d+)", file.name).groups())
    values = np.fromfile(file, "<u2").reshape(rows, columns)[top:bottom, left:right]
    name = file.name.replace(f"{columns}x{rows}", f"{right - left}x{bottom - top}")
    values.tofile(out.with_name(name))


def write_source(folder: Path, out: Path, cut: dict) -> None:
    """What stands in the SOURCE.txt of the full files about these, the licence's holder, and what was cut."""
    text = (folder / "SOURCE.txt").read_text()
    head, *files = re.split(r"\n(?=\S[^\n]*\n    from: )", text)
    kept = [one for one in files if (out / one.split("\n")[0]).exists() or folder.name == "mosaic16_nikon"]
    holders = NAMED.get(folder.name) or sorted({COPYRIGHT[re.search(r"from: github (\S+)", one)[1]] for one in kept})
    here = f"Here: {cut}, cut by tests/data/make.py." if cut else "Here: whole files."
    lines = [*holders, "Texts of the licences: ../LICENCES.txt.", here, "Of the full files:", head.strip(), *kept]
    out.joinpath("SOURCE.txt").write_text("\n".join(lines).rstrip() + "\n")


def main(full: Path) -> None:
    """Write every folder anew."""
    for name, cut in tomllib.loads((HERE / "crops.toml").read_text()).items():
        folder, out = full / name, HERE / name
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        if name == "independent_scenes":
            for scene, frames in cut["frames"].items():
                crop_scene(folder / scene, out / scene, cut["window"], frames)
        for file in sorted(folder.iterdir()) if name != "independent_scenes" else []:
            target = out / file.name
            if file.name == "SOURCE.txt" or file.name not in WANTED.get(name, (file.name,)):
                continue
            if file.suffix == ".cine":
                cut_cine(file, target, cut["frames"])
            elif file.suffix == ".rawi":
                cut_gold(file, target)
            elif file.suffix in (".mraw", ".cih", ".cihx"):
                cut_photron(file, target, cut["frames"])
            elif file.suffix in (".tif", ".tiff"):
                crop_tiff(file, target, cut["window"])
            elif file.suffix == ".bmp":
                left, top, right, bottom = cut["window"]
                cv2.imwrite(str(target), cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[top:bottom, left:right])
            elif file.suffix == ".raw":
                crop_raw(file, target, cut["window"])
            elif name == "raw_colorchart_dng":
                cut_dng(file, target, cut["window"])
            else:
                shutil.copyfile(file, target)
        write_source(folder, out, cut)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
