"""Patches in patches: faces and (u, v) domains cut in four, and those again, where light changes
fast.

A patch that is cut has four children, which follow each other. Those of a triangle (a, b, c) lie
at its corners, and one in the middle of them: (a, ab, ac), (bc, ac, ab), (ab, b, bc), (ac, bc, c),
with ab the middle of the edge from a to b. Those of a rectangle are its quarters, row by row in v.
`locate.PatchLocator` goes down the same way.
"""

from dataclasses import dataclass

import numpy as np

CHILDREN = 4


@dataclass(frozen=True, eq=False)
class QuadTree:
    """Which patches of a surface are cut.

    Parameters
    ----------
    roots : int
        Patches that are not children.
    cuts : tuple of (m,) int arrays
        Patches that are cut, generation by generation; the children of each generation are numbered
        behind all patches before them, in the order of their parents.
    """

    roots: int
    cuts: tuple = ()

    def __len__(self):
        return self.roots + CHILDREN * sum(len(cut) for cut in self.cuts)

    @property
    def children(self):
        """Number (p,) of the first child of each patch, 0 where it is not cut."""
        first = np.zeros(len(self), np.int64)
        count = self.roots
        for cut in self.cuts:
            first[cut] = count + CHILDREN * np.arange(len(cut))
            count += CHILDREN * len(cut)
        return first

    @property
    def leaves(self):
        """Patches (l,) that are not cut, in order."""
        return np.flatnonzero(self.children == 0)

    @property
    def root(self):
        """The root (p,) that each patch is part of."""
        found = np.arange(self.roots)
        for cut in self.cuts:
            found = np.concatenate([found, np.repeat(found[cut], CHILDREN)])
        return found

    @property
    def depth(self):
        """How often each patch (p,) has been cut out of a larger one."""
        found = np.zeros(self.roots, np.int64)
        for cut in self.cuts:
            found = np.concatenate([found, np.repeat(found[cut] + 1, CHILDREN)])
        return found

    def cut(self, patches):
        """The tree with some more leaves cut; itself where there are none."""
        return QuadTree(self.roots, (*self.cuts, np.asarray(patches))) if len(patches) else self

    def triangles(self, faces, vertices):
        """Corners of all patches over triangles.

        Parameters
        ----------
        faces : (roots, 3) int
        vertices : int
            Number of vertices.

        Returns
        -------
        corners : (p, 3) int64
            Indices of vertices, those made by cuts behind the others.
        ends : (m, 2) int64
            Between which two vertices each that was made lies in the middle; they may be made
            themselves, before it.
        """
        corners, ends = np.asarray(faces, np.int64), np.zeros((0, 2), np.int64)
        for cut in self.cuts:
            parents = corners[cut]
            pairs = np.sort(parents[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
            known = np.concatenate([ends, pairs])
            # a middle that is there already keeps its number, new ones follow in order
            _, first, inverse = np.unique(known, axis=0, return_index=True, return_inverse=True)
            inverse = inverse.ravel()
            fresh = np.sort(first[first >= len(ends)])
            number = np.empty(len(first), np.int64)
            old = first < len(ends)
            number[old] = first[old]
            number[~old] = len(ends) + np.searchsorted(fresh, first[~old])
            middles = vertices + number[inverse[len(ends) :]].reshape(-1, 3)
            ends = np.concatenate([ends, known[fresh]])
            (a, b, c), (ab, bc, ca) = parents.T, middles.T
            made = np.stack([(a, ab, ca), (bc, ca, ab), (ab, b, bc), (ca, bc, c)])
            corners = np.concatenate([corners, made.transpose(2, 0, 1).reshape(-1, 3)])
        return corners, ends

    def barycentrics(self):
        """Barycentric coordinates (p, 3, 3) of each patch's corners in its root, exact."""
        corners = np.tile(np.eye(3), (self.roots, 1, 1))
        for cut in self.cuts:
            a, b, c = corners[cut].transpose(1, 0, 2)
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            made = np.stack([(a, ab, ca), (bc, ca, ab), (ab, b, bc), (ca, bc, c)])
            corners = np.concatenate([corners, made.transpose(2, 0, 1, 3).reshape(-1, 3, 3)])
        return corners

    def rectangles(self):
        """Bounds (p, 4) of all patches over (u, v): least u and v, largest u and v."""
        bounds = np.tile([0.0, 0, 1, 1], (self.roots, 1))
        for cut in self.cuts:
            low_u, low_v, high_u, high_v = bounds[cut].T
            u, v = (low_u + high_u) / 2, (low_v + high_v) / 2
            made = np.stack(
                [
                    (low_u, low_v, u, v),
                    (u, low_v, high_u, v),
                    (low_u, v, u, high_v),
                    (u, v, high_u, high_v),
                ]
            )
            bounds = np.concatenate([bounds, made.transpose(2, 0, 1).reshape(-1, 4)])
        return bounds


def with_middles(values, ends):
    """Values (v, …) of vertices with those of the middles between them appended."""
    values = np.asarray(values)
    found = np.concatenate([values, np.empty((len(ends), *values.shape[1:]), values.dtype)])
    done = len(values)
    while done < len(found):
        rest = ends[done - len(values) :]
        # middles of what is there by now
        ready = int(np.argmax((rest >= done).any(axis=1))) if (rest >= done).any() else len(rest)
        one, other = found[rest[:ready, 0]], found[rest[:ready, 1]]
        found[done : done + ready] = (one + other) / 2
        done += ready
    return found
