"""morph-dslam: physics-based reduced models tracked in video."""

__version__ = "0.1.0"
