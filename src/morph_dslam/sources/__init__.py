"""Where frames come from: folders of images and video files."""

from morph_dslam.sources.frames import Frame, FrameSource, open_source

__all__ = ["Frame", "FrameSource", "open_source"]
