"""Virtual experiments: ray-traced painted bodies under coloured lights, seen by a colour camera, with exact truth."""

from rgbmidic.illumination.spectra import Led, Sensitivities
from rgbmidic.lab.virtual.recording import record
from rgbmidic.lab.virtual.rendering import render
from rgbmidic.lab.virtual.scenes import expose, paper_scene, plate_scene, sphere_scene, strained_plate, turned
from rgbmidic.scene.camera import Camera, reference_camera
from rgbmidic.scene.in_plane import AffineField, MeshField
from rgbmidic.scene.light import Light
from rgbmidic.scene.projection import material_points, truth
from rgbmidic.scene.scene import Cylinder, Plate, Scene, Sphere, State
from rgbmidic.scene.surface import Finish, Surface, height_map

__all__ = [
    "AffineField",
    "Camera",
    "Cylinder",
    "Finish",
    "Led",
    "Light",
    "MeshField",
    "Plate",
    "Scene",
    "Sensitivities",
    "Sphere",
    "State",
    "Surface",
    "expose",
    "height_map",
    "material_points",
    "paper_scene",
    "plate_scene",
    "record",
    "reference_camera",
    "render",
    "sphere_scene",
    "strained_plate",
    "truth",
    "turned",
]
