"""Mitsuba's object graph, one level at a time."""

import numpy as np

from ..runtime import mitsuba


def children(node):
    """(name, object) of the objects directly below a Mitsuba object, as its traversal shows them."""
    mi = mitsuba()

    class Collector(mi.TraversalCallback):
        def __init__(self):
            super().__init__()
            self.found = []

        def put(self, name, value, flags, cpptype=None):
            if isinstance(value, mi.Object):
                self.found.append((name, value))

    collector = Collector()
    node.traverse(collector)
    return collector.found


def transform_of(node):
    """An object's `to_world` as (4, 4) float64."""
    return np.array(mitsuba().traverse(node)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
