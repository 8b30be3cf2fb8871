"""Figures, reports and pages of text and pictures of a result."""

from rgbmidic.renamed import refuse_old_names
from rgbmidic.report.curves import Curve, history_figure, profile_figure, wave_text
from rgbmidic.report.document import write_batch_page, write_report
from rgbmidic.report.figures import (
    MAPS,
    MapDrawer,
    brightness_figure,
    convergence_figure,
    residual_figure,
)
from rgbmidic.report.gallery import REPORT, remove_pictures, write_figures, write_maps
from rgbmidic.report.movie import FieldMovie, write_movie
from rgbmidic.report.page import render
from rgbmidic.report.style import STYLE, finish_plot, save_figure

__all__ = [
    "MAPS",
    "REPORT",
    "STYLE",
    "Curve",
    "FieldMovie",
    "MapDrawer",
    "brightness_figure",
    "convergence_figure",
    "finish_plot",
    "history_figure",
    "profile_figure",
    "remove_pictures",
    "render",
    "residual_figure",
    "save_figure",
    "wave_text",
    "write_batch_page",
    "write_figures",
    "write_maps",
    "write_movie",
    "write_report",
]


__getattr__ = refuse_old_names(__name__)
