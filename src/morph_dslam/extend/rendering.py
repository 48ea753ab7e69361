"""Drawing of models: the rasteriser, textures, overlays on images, and pictures of states."""

from morph_dslam.render.model_view import draw_states as draw_states
from morph_dslam.render.overlay import draw_overlay as draw_overlay
from morph_dslam.render.rasteriser import rasterise as rasterise
from morph_dslam.render.scene_file import load_scene_file as load_scene_file
from morph_dslam.render.scene_renderer import print_texture as print_texture
from morph_dslam.render.texture import render_textured as render_textured, sheet_bounds as sheet_bounds
