"""Photographs of a part by a tracer of its own, in NumPy and SciPy: what `studies.photograph` is judged by.

It shares nothing with the package but the control net: the spline is SciPy's, refraction the vector form of Snell's law, power that
of the projected area (Fresnel losses vary by less than a part in a thousand over the slopes of these lenses), the sensor an area
average over its own pixels in the photograph's geometry.
"""

import io

import numpy as np
from PIL import Image
from scipy import fft
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


def landed_from(lens, heights, error, point=None, angle=0.0, rays=600, seed=0):
    """Where light of a point source (x, y, z), mm, or of a sun of this half angle, degrees, around the axis lands behind a lens or
    before a mirror: x and y from the middle of the screen, and power, (N,) each, by Newton's method on the surface."""
    scene, (rx, ry), mirror = lens.scene, lens.field.half_size, lens.scene.lens.mirror
    n, rng = scene.lens.index, np.random.default_rng(seed)
    fine = [np.linspace(-r, r, 900) for r in (rx, ry)]
    z = surface_at(lens.field, heights, *fine)[0]
    if error is not None:
        z = z + RectBivariateSpline(*(np.linspace(-r, r, k) for r, k in zip((rx, ry), error.shape, strict=True)), error)(*fine)
    surface = RectBivariateSpline(*fine, z)
    middle = float(z.mean())
    plane = middle if mirror else scene.lens.z_in
    x, y = ((1.02 * r * (2.0 * (np.arange(rays) + rng.uniform()) / rays - 1.0)) for r in (rx, ry))
    x, y = (c.ravel() for c in np.meshgrid(x, y, indexing="ij"))
    if point is None:
        rho, phi = np.sin(np.radians(angle)) * np.sqrt(rng.uniform(size=x.shape)), 2 * np.pi * rng.uniform(size=x.shape)
        d = np.stack([rho * np.cos(phi), rho * np.sin(phi), np.sqrt(1 - rho**2)])
        power = np.ones_like(x)
    else:
        d = np.stack([x - point[0], y - point[1], np.full_like(x, plane - point[2])])
        r = np.linalg.norm(d, axis=0)
        d, power = d / r, d[2] / r**3
    if not mirror:
        d = np.stack([d[0] / n, d[1] / n, np.sqrt(1 - (d[0] ** 2 + d[1] ** 2) / n**2)])
    t = (middle - plane) / d[2]
    for _ in range(5):
        px, py = x + t * d[0], y + t * d[1]
        zx, zy = surface.ev(px, py, dx=1), surface.ev(px, py, dy=1)
        t -= (plane + t * d[2] - surface.ev(px, py)) / (d[2] - zx * d[0] - zy * d[1])
    px, py, pz = x + t * d[0], y + t * d[1], plane + t * d[2]
    normal = np.stack([-zx, -zy, np.ones_like(zx)]) / np.sqrt(1 + zx**2 + zy**2)
    cosine = (d * normal).sum(0)
    bent = np.sqrt(1 - n * n * (1 - cosine**2)) - n * cosine
    d = d - 2 * cosine * normal if mirror else n * d + bent * normal
    far = (scene.screen.z - pz) / d[2]
    inside = (np.abs(px) < rx) & (np.abs(py) < ry)
    sx, sy = scene.screen.shift
    return px + far * d[0] - sx, py + far * d[1] - sy, np.where(inside, power, 0.0)


def leaving(lens, heights, error, origin, direction, index):
    """Rays in the glass, origins and unit directions (3, N), met by the exit surface with an error by Newton's method and refracted
    into air: points and unit directions, (3, N).  index: where they leave, a number or a function of the points."""
    rx, ry = lens.field.half_size
    fine = [np.linspace(-r, r, 900) for r in (rx, ry)]
    z = surface_at(lens.field, heights, *fine)[0]
    if error is not None:
        z = z + RectBivariateSpline(*(np.linspace(-r, r, k) for r, k in zip((rx, ry), error.shape, strict=True)), error)(*fine)
    surface = RectBivariateSpline(*fine, z)
    t = (float(z.mean()) - origin[2]) / direction[2]
    for _ in range(6):
        px, py, _ = origin + t * direction
        zx, zy = surface.ev(px, py, dx=1), surface.ev(px, py, dy=1)
        t -= (origin[2] + t * direction[2] - surface.ev(px, py)) / (direction[2] - zx * direction[0] - zy * direction[1])
    point = origin + t * direction
    zx, zy = (surface.ev(*point[:2], **order) for order in ({"dx": 1}, {"dy": 1}))
    normal = np.stack([-zx, -zy, np.ones_like(zx)]) / np.sqrt(1 + zx**2 + zy**2)
    n = index(point) if callable(index) else index
    return point, refracted(direction, normal, n)


def refracted(direction, normal, ratio):
    """Unit directions (3, N) behind an interface with unit normals along the light, and the ratio of the indices before and behind
    it (Snell's law in vector form)."""
    cosine = (direction * normal).sum(0)
    return ratio * direction + (np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2)) - ratio * cosine) * normal


def lattice(lens, rays):
    """Points of a square lattice of rays x rays over the aperture, (2, N) mm."""
    x, y = ((2.0 * (np.arange(rays) + 0.5) / rays - 1.0) * r for r in lens.field.half_size)
    return np.stack([c.ravel() for c in np.meshgrid(x, y, indexing="ij")])


def waves(lens, heights, error, wavelengths=(0.00047, 0.00055, 0.00063), samples=3072, coarse=500, throw=None):
    """Light of a plane wave behind a part on the screen as waves: half widths (mm) of a square grid and irradiance on it, over its
    mean on the screen; wavelengths: mm.

    The optical path behind the part, on a plane above it, follows rays; from there one Fourier transform (Goodman, Introduction to
    Fourier optics, eq. 4-17), with `samples` along each side of the aperture.
    """
    scene, (rx, ry), n = lens.scene, lens.field.half_size, lens.scene.lens.index
    x, y = (np.linspace(-r, r, coarse) for r in (rx, ry))
    z, zx, zy = surface_at(lens.field, heights, x, y)
    if error is not None:
        ends = [np.linspace(-r, r, k) for r, k in zip((rx, ry), error.shape, strict=True)]
        spline = RectBivariateSpline(*ends, error)
        z, zx, zy = z + spline(x, y), zx + spline(x, y, dx=1), zy + spline(x, y, dy=1)
    normal = np.stack([-zx, -zy, np.ones_like(z)]) / np.sqrt(1 + zx**2 + zy**2)
    t = np.sqrt(1.0 - n * n * (1.0 - normal[2] ** 2)) - n * normal[2]
    d = np.array([0.0, 0.0, n])[:, None, None] + t * normal
    plane = z.max()
    far = (plane - z) / d[2]
    path, moved = RectBivariateSpline(x, y, n * z + far), [RectBivariateSpline(x, y, far * c) for c in d[:2]]
    X, Y = np.meshgrid(x, y, indexing="ij")
    at = [X.copy(), Y.copy()]
    for _ in range(4):  # where the rays through the grid of the plane leave the part
        at = [c - m.ev(*at) for c, m in zip((X, Y), moved, strict=True)]
    (axx, axy), (ayx, ayy) = ([np.gradient(c, g, axis=k) for k, g in enumerate((x, y))] for c in at)
    path, density = RectBivariateSpline(x, y, path.ev(*at)), RectBivariateSpline(x, y, axx * ayy - axy * ayx)
    fine = [(2.0 * (np.arange(samples) + 0.5) / samples - 1.0) * r for r in (rx, ry)]
    path, density, far = path(*fine), density(*fine), (scene.screen.z if throw is None else throw) - plane
    count, step, light, half = fft.next_fast_len(4 * samples // 3), 2.0 * rx / samples, [], []
    for wavelength in wavelengths:
        k = 2.0 * np.pi / wavelength
        bent = (fine[0][:, None] ** 2 + fine[1][None, :] ** 2) / (2.0 * far)
        field = np.sqrt(density) * np.exp(1j * (k * ((path + bent) % wavelength)))
        light.append(np.fft.fftshift(np.abs(fft.fft2(field, (count, count))) ** 2))
        half.append(wavelength * far / (2.0 * step))
    ends = [h * (2.0 * np.arange(count) / count - 1.0) for h in half]
    common = ends[0]
    total = sum(
        RectBivariateSpline(e, e, a, kx=1, ky=1)(common, common) * (half[0] / h) ** 2
        for e, a, h in zip(ends, light, half, strict=True)
    )
    sx, sy = scene.screen.half_size
    total /= total.sum() * (common[1] - common[0]) ** 2 / (4.0 * sx * sy)
    return common, total


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
    wave=None,
    light=None,
    sag=None,
    lift=(0.0, 0.0, 0.0),
    colours=None,
    **how,
):
    """An 8-bit photograph (rows, columns): of the screen through a projective camera with distortion; bytes of its JPEG, and the
    function that images (X, Y) of the screen, in half widths.

    view: (8,) projective map from (X, Y) to pixels before distortion; exposure: of the brightest 0.2 % of pixels, 1 saturates;
    marks: (N, 2) centres of dark discs and their radius; wave: light on the screen as of `waves`, instead of rays;
    light: rays as of `landed_from`; sag: height of a curved screen at (X, Y), half widths, and lift (3,) what it adds to the view;
    colours: (3, 3) linear R, G, B of the light of each of three colours, whose rays are then three of them.
    """
    w, h = size
    view = np.array([0.36 * w, 0.02 * w, 0.5 * w, 0.015 * h, -0.40 * h, 0.49 * h, 0.03, -0.02]) if view is None else view
    (cx, cy), half = ((w - 1) / 2, (h - 1) / 2), 0.5 * np.hypot(w, h)

    def project(X, Y):
        S = 0.0 if sag is None else sag(X, Y)
        q = view[6] * X + view[7] * Y + lift[2] * S + 1.0
        a = (view[0] * X + view[1] * Y + lift[0] * S + view[2]) / q
        b = (view[3] * X + view[4] * Y + lift[1] * S + view[5]) / q
        a, b = (a - cx) / half, (b - cy) / half
        s = 1.0 + distortion * (a * a + b * b)
        return cx + half * s * a, cy + half * s * b

    rx, ry = lens.scene.screen.half_size
    if colours is not None:
        each = [_counted(project, size, *rays, rx, ry) for rays in light]
        light = np.clip(np.tensordot(colours, each, 1), 0.0, None)
    elif wave is None:
        x, y, *power = light or landed(lens, heights, error, rays=rays, **how)
        light = _counted(project, size, x, y, power[0] if power else np.ones_like(x), rx, ry)
    else:
        X, Y = _inverse(project, size)
        light = RectBivariateSpline(wave[0], wave[0], wave[1], kx=1, ky=1).ev(X * rx, Y * ry)
        light = light.reshape(h, FINER, w, FINER).mean((1, 3))
    width = (*[0.0] * (light.ndim - 2), blur, blur)
    radiance = exposure / np.percentile(gaussian_filter(light, width), 99.8) * light + background
    if marks is not None:
        centres, radius = marks
        X, Y = _inverse(project, size)
        dark = np.zeros(X.shape)
        for x0, y0 in centres:
            dark[np.square(X - x0) + np.square(Y - y0) < radius**2] = 1.0
        dark = dark.reshape(h, FINER, w, FINER).mean((1, 3))
        radiance = radiance * (1.0 - 0.95 * dark)
    rng = np.random.default_rng(seed)
    light = gaussian_filter(radiance, width)
    codes = np.clip(light, 0, 1) ** (1 / gamma) + noise * rng.standard_normal(light.shape)
    pixels = np.rint(255 * np.clip(codes, 0, 1)).astype(np.uint8)
    data = io.BytesIO()
    upright = np.ascontiguousarray(np.moveaxis(pixels, 0, -1)) if pixels.ndim == 3 else pixels
    Image.fromarray(upright).save(data, "JPEG", quality=quality)
    return data.getvalue(), project


def _counted(project, size, x, y, power, rx, ry):
    """Radiance on the pixels of a sensor, over the mean of the screen, from rays."""
    w, h = size
    a, b = project(x / rx, y / ry)
    light = np.histogram2d(b, a, [np.arange(n + 1) - 0.5 for n in (h, w)], weights=power)[0]
    # irradiance on the wall is power per area of wall: a sensor sees radiance, so undo the area that a pixel covers there
    X, Y = np.meshgrid(np.linspace(-1.6, 1.6, 81), np.linspace(-1.6, 1.6, 81))
    e = 1e-4
    (a0, b0), (a1, b1), (a2, b2) = project(X, Y), project(X + e, Y), project(X, Y + e)
    area = np.abs((a1 - a0) * (b2 - b0) - (a2 - a0) * (b1 - b0)) / e**2
    jj, ii = np.meshgrid(np.arange(w), np.arange(h))
    pixels = LinearNDInterpolator(np.stack([a0.ravel(), b0.ravel()], 1), area.ravel(), fill_value=area.mean())(jj, ii)
    return light * pixels / (power.sum() / 4.0)  # over the mean of all light on the screen


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
