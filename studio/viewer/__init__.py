"""The studio's page: a viser scene with panels round it."""

from studio.viewer.viewer import Viewer

__all__ = ["Viewer"]
