"""What is made of a finished result: figures, the pictures beside it, pages of text and pictures."""

from rgbmidic.report.figures import (
    brightness_figure,
    convergence_figure,
    displacement_figure,
    mask_figure,
    reflection_figure,
    residual_figure,
    save_figure,
    share_figure,
    uncertainty_figure,
)
from rgbmidic.report.gallery import remove_figures, write_figures
from rgbmidic.report.page import Page

__all__ = [
    "Page",
    "brightness_figure",
    "convergence_figure",
    "displacement_figure",
    "mask_figure",
    "reflection_figure",
    "remove_figures",
    "residual_figure",
    "save_figure",
    "share_figure",
    "uncertainty_figure",
    "write_figures",
]
