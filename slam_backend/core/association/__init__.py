"""Data association: which landmark a sighting without an id is of."""

from .associator import Associator

__all__ = ["Associator"]
