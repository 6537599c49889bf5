"""The studio's page: a viser scene with panels round it."""

from studio.viewer.start import StartRequest
from studio.viewer.viewer import Viewer

__all__ = ["StartRequest", "Viewer"]
