"""Photographs of a part by a tracer of its own, in NumPy and SciPy: what `studies.photograph` is judged by.

It shares nothing with the package but the control net: the spline is SciPy's, refraction the vector form of Snell's law, power that
of the projected area (Fresnel losses vary by less than a part in a thousand over the slopes of these lenses), the sensor an area
average over its own pixels in the photograph's geometry.
"""

import io

import numpy as np
from PIL import Image
from scipy.interpolate import BSpline, CloughTocher2DInterpolator, LinearNDInterpolator, RectBivariateSpline
from scipy.ndimage import gaussian_filter
from scipy.sparse import csc_matrix, hstack

#: Points along each side of a pixel by which marks are drawn.
FINER = 3


def form_error(half, rms, length, seed, points=257):
    """A form error, mm, on a grid over the aperture: Gaussian, of this RMS, with the autocorrelation exp(-(r / length)^2)."""
    rng, pad = np.random.default_rng(seed), points
    noise = rng.standard_normal((points + 2 * pad, points + 2 * pad))
    sigma = length / 2.0 / (2.0 * half / (points - 1))
    z = gaussian_filter(noise, sigma, mode="wrap")[pad:-pad, pad:-pad]
    z -= z.mean()
    return rms * z / z.std()


def surface_at(field, heights, x, y):
    """Height and slopes on the grid of x and y, mm."""
    spaces, (rx, ry) = field.spaces, field.half_size
    u, v = (np.clip(0.5 * (c / r + 1.0), 0.0, 1.0) for c, r in ((x, rx), (y, ry)))
    (bu, du), (bv, dv) = (
        (BSpline.design_matrix(c, s.knots.numpy(), s.degree), _slopes(c, s)) for c, s in zip((u, v), spaces, strict=True)
    )
    h = heights.numpy()
    return bu @ h @ bv.T, du @ h @ bv.T / (2 * rx), bu @ h @ dv.T / (2 * ry)


def _slopes(c, space):
    """Derivatives of B-splines, differences of those of one degree less (de Boor, A practical guide to splines, 1978)."""
    knots, p = space.knots.numpy(), space.degree
    n = len(knots) - p - 1
    width = knots[p + 1 : p + n] - knots[1:n]
    factor = np.divide(p, width, out=np.zeros_like(width), where=width > 0)
    scaled = BSpline.design_matrix(c, knots[1:-1], p - 1).multiply(factor[None]).tocsc()
    zero = csc_matrix((len(c), 1))
    return (hstack([zero, scaled]) - hstack([scaled, zero])).tocsr()


def landed(lens, heights, error, rays=1400, index=None, throw=None):
    """Where rays of a plane wave along the axis land, mm (N,) each, behind a part with an error on a grid over its aperture."""
    scene, (rx, ry) = lens.scene, lens.field.half_size
    x, y = ((2.0 * (np.arange(rays) + 0.5) / rays - 1.0) * r for r in (rx, ry))
    z, zx, zy = surface_at(lens.field, heights, x, y)
    if error is not None:
        ends = [np.linspace(-r, r, n) for r, n in zip((rx, ry), error.shape, strict=True)]
        spline = RectBivariateSpline(*ends, error)
        z, zx, zy = z + spline(x, y), zx + spline(x, y, dx=1), zy + spline(x, y, dy=1)
    n = scene.lens.index if index is None else index
    normal = np.stack([-zx, -zy, np.ones_like(z)]) / np.sqrt(1 + zx**2 + zy**2)
    cosine = normal[2]  # of a ray along z
    t = np.sqrt(1.0 - n * n * (1.0 - cosine**2)) - n * cosine
    d = np.array([0.0, 0.0, n])[:, None, None] + t * normal
    far = ((scene.screen.z if throw is None else throw) - z) / d[2]
    return (x[:, None] + far * d[0]).ravel(), (y[None] + far * d[1]).ravel()


def image_of(lens, heights, error, resolution, **how):
    """The image on the screen's pixels: counted rays, over their mean."""
    (x, y), half = landed(lens, heights, error, **how), lens.scene.screen.half_size
    edges = [np.linspace(-r, r, n + 1) for r, n in zip(half, resolution, strict=True)]
    counts = np.histogram2d(x, y, edges)[0]
    return counts / counts.mean()


def photographed(
    lens,
    heights,
    error,
    *,
    size=(900, 800),
    view=None,
    distortion=0.01,
    blur=1.2,
    exposure=0.8,
    background=0.01,
    gamma=2.4,
    noise=0.005,
    quality=92,
    seed=0,
    rays=1400,
    marks=None,
    **how,
):
    """An 8-bit photograph (rows, columns): of the screen through a projective camera with distortion; bytes of its JPEG, and the
    function that images (X, Y) of the screen, in half widths.

    view: (8,) projective map from (X, Y) to pixels before distortion; exposure: of the brightest 0.2 % of pixels, 1 saturates;
    marks: (N, 2) centres of dark discs and their radius.
    """
    w, h = size
    view = np.array([0.36 * w, 0.02 * w, 0.5 * w, 0.015 * h, -0.40 * h, 0.49 * h, 0.03, -0.02]) if view is None else view
    (cx, cy), half = ((w - 1) / 2, (h - 1) / 2), 0.5 * np.hypot(w, h)

    def project(X, Y):
        q = view[6] * X + view[7] * Y + 1.0
        a, b = (view[0] * X + view[1] * Y + view[2]) / q, (view[3] * X + view[4] * Y + view[5]) / q
        a, b = (a - cx) / half, (b - cy) / half
        s = 1.0 + distortion * (a * a + b * b)
        return cx + half * s * a, cy + half * s * b

    x, y = landed(lens, heights, error, rays=rays, **how)
    rx, ry = lens.scene.screen.half_size
    a, b = project(x / rx, y / ry)
    light = np.histogram2d(b, a, [np.arange(n + 1) - 0.5 for n in (h, w)])[0]
    # irradiance on the wall is power per area of wall: a sensor sees radiance, so undo the area that a pixel covers there
    X, Y = np.meshgrid(np.linspace(-1.6, 1.6, 81), np.linspace(-1.6, 1.6, 81))
    e = 1e-4
    (a0, b0), (a1, b1), (a2, b2) = project(X, Y), project(X + e, Y), project(X, Y + e)
    area = np.abs((a1 - a0) * (b2 - b0) - (a2 - a0) * (b1 - b0)) / e**2
    jj, ii = np.meshgrid(np.arange(w), np.arange(h))
    pixels = LinearNDInterpolator(np.stack([a0.ravel(), b0.ravel()], 1), area.ravel(), fill_value=area.mean())(jj, ii)
    light = light * pixels / (len(x) / 4.0)  # over the mean of all light on the screen
    radiance = exposure / np.percentile(gaussian_filter(light, blur), 99.8) * light + background
    if marks is not None:
        centres, radius = marks
        X, Y = _inverse(project, size)
        dark = np.zeros(X.shape)
        for x0, y0 in centres:
            dark[np.square(X - x0) + np.square(Y - y0) < radius**2] = 1.0
        dark = dark.reshape(h, FINER, w, FINER).mean((1, 3))
        radiance = radiance * (1.0 - 0.95 * dark)
    rng = np.random.default_rng(seed)
    light = gaussian_filter(radiance, blur)
    codes = np.clip(light, 0, 1) ** (1 / gamma) + noise * rng.standard_normal(light.shape)
    pixels = np.rint(255 * np.clip(codes, 0, 1)).astype(np.uint8)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "JPEG", quality=quality)
    return data.getvalue(), project


def _inverse(project, size):
    """(X, Y) of points FINER times finer than the pixels, by interpolation of the inverse of a net that is imaged."""
    w, h = size
    X, Y = np.meshgrid(np.linspace(-2.2, 2.2, 121), np.linspace(-2.2, 2.2, 121))
    places = np.stack([c.ravel() for c in project(X, Y)], 1)
    inverse = CloughTocher2DInterpolator(places, np.stack([X.ravel(), Y.ravel()], 1), fill_value=9.0)
    a, b = np.linspace(-1, w, 150), np.linspace(-1, h, 150)
    coarse = inverse(*np.meshgrid(a, b, indexing="ij"))
    fine = [(np.arange(FINER * n) + 0.5) / FINER - 0.5 for n in (w, h)]
    return tuple(RectBivariateSpline(a, b, coarse[..., k])(*fine).T for k in (0, 1))


def relative_rms(image, target):
    """RMS of the difference of two images, each over its mean."""
    return float(np.sqrt(np.mean((image / image.mean() - target / target.mean()) ** 2)))
