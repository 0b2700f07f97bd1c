"""Mitsuba's object graph, one level at a time."""

import hashlib

import numpy as np

from ..system.runtime import mitsuba


def children(node):
    """(name, object) of the objects directly below a Mitsuba object, as its traversal shows
    them.
    """
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
    found = find_transform(node)
    if found is None:
        raise KeyError("to_world")
    return found


def find_transform(node):
    """An object's `to_world` as (4, 4) float64; None if it has none."""
    mi = mitsuba()

    class Finder(mi.TraversalCallback):
        def __init__(self):
            super().__init__()
            self.found = None

        def put(self, name, value, flags, cpptype=None):
            if name == "to_world" and cpptype is not None:
                self.found = mi.get_property(value, cpptype, node)

    finder = Finder()
    node.traverse(finder)
    if finder.found is None:
        return None
    return np.array(finder.found.matrix, dtype=np.float64).reshape(4, 4)


def digest_of(nodes, keep=lambda key: True):
    """SHA-256 of the class names and parameters of Mitsuba objects, as hexadecimal digits.

    Parameters
    ----------
    nodes : iterable of mi.Object
    keep : callable(key)
        Which parameters count.
    """
    digest = hashlib.sha256()
    for node in nodes:
        digest.update(node.class_name().encode())
        parameters = mitsuba().traverse(node)
        # SceneParameters iterates over pairs
        for key in sorted(key for key in parameters.keys() if keep(key)):
            value = parameters[key]
            # Asked by type: Dr.Jit reads `matrix` of a vector as a swizzle of its components.
            value = value.matrix if "Transform" in type(value).__name__ else value
            digest.update(key.encode() + np.ascontiguousarray(np.array(value)).tobytes())
    return digest.hexdigest()
