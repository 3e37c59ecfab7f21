"""Point masses anywhere, as sites of a transport map: where pixels do not lie on a lattice in the coordinates of the map.

On rows the Legendre transforms of phi split along the axes (`optics.kernels.laguerre`); of scattered sites phi is the lower convex
hull of the points (y_p, psi_p), whose edges join the sites that share a border (Aurenhammer, SIAM J. Comput. 16, 1987).  As phi is
convex, a site whose plane is above those of its neighbours at a point is above all, so that a raster is labelled by walks from
point to point.

A light site is concentrated in a point of its pixel, or of a few dark ones.  Resampled onto a lattice that is moved by part of a
pixel, neighbouring pixels would receive two of these points or none; so sites keep their masses and their positions are moved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from caustic_cli.inverse.creases import Spots
from caustic_cli.inverse.transport import point_masses
from caustic_cli.loading import OnDemand

spatial, laguerre = OnDemand("scipy.spatial"), OnDemand("caustic_cli.optics.kernels.laguerre")

#: Distance of the four corners added around all sites, in their extent; part of the source's half sizes beyond which they may be on
#: the envelope.
AROUND, BEYOND = 1.0, 1.5
EVERY = 4  # points of a raster, one of which is among those where its gradient is known
OPTIONS = "Qt Q12"  # triangulated; with wide facets where sites are nearly coplanar


@dataclass(frozen=True, eq=False)
class Scattered:
    """Point masses (N,) at y1, y2 (N,), mm, for a source of these half sizes, mm; their own places, (2, N) mm; and
    what they are of a picture, if of one."""

    y1: np.ndarray
    y2: np.ndarray
    mass: np.ndarray
    half: tuple[float, float]
    home: np.ndarray
    spots: Spots | None = None
    _last: list[LowerHull] = field(default_factory=list, init=False, repr=False)

    def envelope(self, psi: np.ndarray) -> LowerHull:
        """phi of these sites at prices psi (N,), mm^2; that of the last ones is kept."""
        if not (self._last and np.array_equal(psi, self._last[0].psi)):
            self._last[:] = [LowerHull(psi, self)]
        return self._last[0]

    def displaced(self, by1: np.ndarray, by2: np.ndarray) -> Scattered:
        """The same displaced from their own places, by (N,) mm along each axis."""
        return replace(self, y1=self.home[0] + by1, y2=self.home[1] + by2)

    def prices(self, phi: np.ndarray, raster: list, inside: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Prices (N,), mm^2, at which the planes of the sites touch phi on a raster, or on its part `inside`, and where, as of
        `laguerre.prices`: climbing from the nearest of every few points by the gradient of phi."""
        few = [slice(None, None, max(1, min(EVERY, len(x) // 2))) for x in raster]
        slopes = np.stack(np.gradient(phi[few[0], few[1]], *(x[every] for x, every in zip(raster, few, strict=True))))
        begin = np.arange(phi.size).reshape(phi.shape)[few[0], few[1]].ravel()
        slopes = slopes.reshape(2, -1)
        if inside is not None:
            lit = inside.ravel()[begin]
            begin, slopes, phi = begin[lit], slopes[:, lit], np.where(inside, phi, np.inf)
        nearest = spatial.cKDTree(slopes.T).query(np.column_stack([self.y1, self.y2]))[1]
        return laguerre.climbed(phi, self.y1, self.y2, *raster, begin[nearest])


@dataclass(frozen=True, eq=False)
class LowerHull:
    """phi of scattered sites at prices psi (N,), mm^2, by the lower convex hull of the points (y_p, psi_p)."""

    psi: np.ndarray
    sites: Scattered

    @cached_property
    def planes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """y1, y2 and prices of the sites, and of four more around them whose planes lie below phi wherever the source is: they
        make a hull of sites on one line too."""
        s = self.sites
        low, high = _limits(s.y1, s.y2)
        y1, y2 = ([low[0], low[0], high[0], high[0]], [low[1], high[1], low[1], high[1]])
        away = [BEYOND * h * np.abs(c - own[0]) for h, c, own in zip(s.half, (y1, y2), (s.y1, s.y2), strict=True)]
        return np.append(s.y1, y1), np.append(s.y2, y2), np.append(self.psi, self.psi[0] + sum(away))

    @cached_property
    def neighbours(self) -> tuple[np.ndarray, np.ndarray]:
        """Sites that share a border with each of `planes`: those of p are other[first[p] : first[p + 1]]."""
        points = np.column_stack(self.planes)
        points = (points - points.mean(0)) / np.ptp(points, axis=0)
        hull = spatial.ConvexHull(points, qhull_options=OPTIONS)
        below = hull.simplices[hull.equations[:, 2] < 0.0]
        edges = np.concatenate([below[:, [0, 1, 2]].ravel(), below[:, [1, 2, 0]].ravel()])
        ends = np.concatenate([edges[edges.size // 2 :], edges[: edges.size // 2]])
        graph = csr_matrix((np.ones(len(edges), bool), (edges, ends)), (len(points), len(points)))
        return graph.indptr.astype(np.int64), graph.indices

    def borders(self, site: np.ndarray) -> tuple[np.ndarray, ...]:
        """As of `laguerre.borders`, also of cells too narrow for a raster."""
        return laguerre.linked(*self.neighbours, len(self.psi))

    def on(self, x1: np.ndarray, x2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of `laguerre.envelope`."""
        first, other = self.neighbours
        return laguerre.walked(*self.planes, first, other, int(other[0]), x1, x2)

    def touched(self, missing: np.ndarray, phi: np.ndarray, site: np.ndarray, raster: list, inside: np.ndarray | None) -> tuple:
        """As of those on rows."""
        s = self.sites
        back, at = replace(s, y1=s.y1[missing], y2=s.y2[missing]).prices(phi, raster, inside)
        return back, site.ravel()[at].astype(np.int64)


def _limits(y1: np.ndarray, y2: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lower and upper corner of a rectangle far around points."""
    span = AROUND * max(float(np.ptp(y1)), float(np.ptp(y2)), 1e-9 + float(np.abs(y1).max()))
    return (float(y1.min()) - span, float(y2.min()) - span), (float(y1.max()) + span, float(y2.max()) + span)


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of a picture and where they lie in the coordinates of a map."""

    #: Power (k, l); half width and height of the frame of the pixels, mm.
    power: np.ndarray
    half: tuple[float, float]
    #: Coordinates of the map of points x, y in that frame, mm, and their origin.
    project: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    centre: tuple[float, float] = (0.0, 0.0)

    def sites(self, source: np.ndarray, source_half: tuple[float, float], fewer: int = 1, times: int = 1) -> Scattered:
        """The point masses of this picture for a source of these cells, or `fewer` times fewer; times: as of `transport.solve`."""
        x, y, mass = point_masses(source, self.power, self.half, fewer=fewer, times=times)
        spots = Spots((x, y), mass, self.power > 0, self.half)
        if self.project:
            x, y = (c - middle for c, middle in zip(self.project(x, y), self.centre, strict=True))
        return Scattered(x, y, mass, source_half, np.stack([x, y]), spots)
