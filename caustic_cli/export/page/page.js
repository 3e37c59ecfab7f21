"use strict";
// Traces the lens that the page holds, shows it, and answers the controls.  Lengths are mm, angles degrees where a person reads them.
//
// The image is the sum of beams: light of one point of the source at one refractive index.  A beam is cut by the grid of the exit's
// points into cells.  The rays through a cell's four corners are traced exactly (Snell's law at the entrance and at the exit,
// Fresnel's losses, absorption); the power that enters through the cell is spread evenly over a rectangle on the screen about the mean
// of the four landing points, as wide as a parallelogram of the same edges has standard deviations, and shared out among the pixels
// that it covers.  No light is lost by that, and where cells are smaller than pixels the image is that of endless rays.
//
//   x, y, z, zx, zy   a point of the exit, its height and slopes         n   refractive index, 1 before a mirror
//   ax, ay, az        direction of the ray in air before the lens        dx, dy, dz   in the glass, before the exit
//   ex, ey            where it enters: on a surface of heights s and slopes sx, sy, flat or free-form; glass, its way from there, mm
//   qx, qy            where it passes the plane of the pupil, which the source illuminates; w, power per area there that arrives
//   px, py            landing point, in pixels from the screen's low edges
//
// The entrance point is that of the path whose optical length is stationary (Fermat's principle), by Newton's method from the path
// that a flat entrance would refract paraxially.  A curved screen is met likewise, from the point of its tangent plane.
//
// The graphics processor does the same in a vertex shader, one point a cell; its text below follows the functions here.

const FRESNEL = { none: 0, schlick: 1, exact: 2 };
const SMALLEST = 1e-3; // of a rectangle's sides, pixels: folded light has none
const MARGIN = 8; // pixels beyond the screen that the graphics processor draws on, since points are dropped by their middle
const SLICE = 14; // ms of work between two answers to the person
const BLUR = 12; // beams for each square pixel of the blur, and at least and at most, of one place of an extended source
const FEWEST_BEAMS = 24, MOST_BEAMS = 300;
const DEEPEST = 100; // times that the relief is shown as deep
const STEPS = 12, FINE = 1e-7; // of Newton's method, at most, and the length of the last, mm, whose error is its square
const GOLDEN = Math.PI * (3 - Math.sqrt(5));
const byId = (id) => document.getElementById(id);
const square = (a) => a * a;

// ---- what the page holds

const held = JSON.parse(byId("data").textContent);

/** Values of a grid (n, m) from deflated differences of 16-bit codes: Float32Array, row after row. */
async function decoded({ shape: [n, m], low, step, data }) {
  const packed = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const values = new Float32Array(n * m), along = new Uint16Array(m);
  for (let i = 0, k = 0; i < n; i++) {
    for (let j = 0, code = 0; j < m; j++, k++) {
      along[j] += bytes[k] + 256 * bytes[k + n * m];
      code = (code + along[j]) & 65535;
      values[k] = low + step * code;
    }
  }
  return values;
}

/** A grid of the heights and slopes of a surface over +-reach, mm; null for none. */
async function gridOf(part, reach) {
  if (!part) return null;
  const [z, zx, zy] = await Promise.all([part.z, part.zx, part.zy].map(decoded)), [nx, ny] = part.z.shape;
  return { nx, ny, z, zx, zy, reach };
}

async function unpacked() {
  const { exit, entrance } = held.cloud, reach = held.lens.size.map((s) => s / 2);
  const cloud = { ...(await gridOf(exit, reach)), entrance: await gridOf(entrance, reach) };
  cloud.shape = await gridOf(held.screen.shape, held.screen.low.map(Math.abs));
  for (const light of held.lights) {
    light.grid = await gridOf(light.front, reach);
    for (const rays of light.rays || []) for (const name of ["x", "y", "ox", "oy", "w"]) rays[name] = await decoded(rays[name]);
  }
  const target = held.target && (await decoded(held.target)), waves = held.waves && (await decoded(held.waves));
  const wavesColour = held.wavesColour && (await Promise.all(held.wavesColour.map(decoded)));
  return { cloud, target, waves, wavesColour };
}

// ---- the light: beams for a setting of the controls

/** The rotation that takes +z to a unit vector, as rows. */
const rotation = ([a, b, c]) => [[1 - (a * a) / (1 + c), (-a * b) / (1 + c), a], [(-a * b) / (1 + c), 1 - (b * b) / (1 + c), b], [-a, -b, c]];

/** The rotation that takes +z to light leaning by angles along x and y, as rows. */
function leaning(leanX, leanY) {
  const p = Math.tan((leanX * Math.PI) / 180), q = Math.tan((leanY * Math.PI) / 180), length = Math.hypot(p, q, 1);
  return rotation([p / length, q / length, 1 / length]);
}

const turned = (rows, v) => rows.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);

/** Points of the unit disc, or of [-1, 1]^2 for a source with a picture, `count` for each of `places`; no two places have the same. */
function spots(light, count, places, place) {
  if (count === 1) return [[0, 0]];
  if (light.picture) {
    const step = light.picture.length / count;
    return Array.from({ length: count }, (_, k) => light.picture[Math.floor((k + 0.5) * step)]);
  }
  return Array.from({ length: count }, (_, q) => {
    const k = q * places + place, r = Math.sqrt((k + 0.5) / (count * places)); // Vogel's spiral, even over the disc
    return [r * Math.cos(GOLDEN * k), r * Math.sin(GOLDEN * k)];
  });
}

/** Half widths of a light's places at a setting: mm, or sines of angles. */
function extentOf(light, size) {
  if (size === null) return light.extent;
  const wide = light.near ? size / 2 : Math.sin((size * Math.PI) / 360), own = Math.max(...light.extent);
  return own > 0 ? light.extent.map((e) => (wide * e) / own) : [wide, wide];
}

/** Directions of light from infinity at points of its disc, each with the part of its radiance that the aperture receives. */
function directions(light, rows, extent, points) {
  const own = rotation(light.axis), axis = turned(rows, light.axis);
  const found = points.map(([u, v]) => {
    const sx = extent[0] * u, sy = extent[1] * v, across = Math.sqrt(1 - sx * sx - sy * sy);
    const [ax, ay, az] = turned(rows, turned(own, [sx, sy, across]));
    return { ax, ay, part: az / (across * axis[2]) };
  });
  const mean = found.reduce((whole, one) => whole + one.part, 0) / found.length;
  return found.map(({ ax, ay, part }) => ({ ax, ay, part: part / mean }));
}

/** Beams of a setting {z, leanX, leanY, size}; at most `most` of them for each place, if given. */
function beamsOf(setting, most = MOST_BEAMS) {
  const rows = leaning(setting.leanX, setting.leanY), beams = [];
  const area = held.lens.size[0] * held.lens.size[1] * (held.lens.round ? Math.PI / 4 : 1), { pixel } = held.screen;
  for (const light of held.lights) {
    for (const rays of light.rays || []) beams.push({ rays, power: rays.part, light, colour: rays.colour });
    const extent = extentOf(light, setting.size), places = light.places.length;
    const far = Math.abs(setting.z - held.lens.zIn) / (light.near ? 1 : light.axis[2]);
    const blur = Math.max(...extent.map((e, k) => ((2 * e) / pixel[k]) * (light.near ? far / Math.abs(light.places[0][2]) : far)));
    let count = blur < 0.2 ? 1 : Math.min(Math.max(FEWEST_BEAMS, Math.ceil(BLUR * blur * blur)), Math.ceil(most / Math.sqrt(places)));
    if (light.picture && count > 1) count = Math.min(most, light.picture.length);
    light.places.forEach(([x, y, z, part], place) => {
      const points = spots(light, count, places, place), from = light.near ? [] : directions(light, rows, extent, points);
      points.forEach(([u, v], k) => {
        for (const [n, of, colour] of light.indices) {
          const power = (light.weight * part * of) / count;
          if (light.near) {
            const [x0, y0, z0] = turned(rows, [x + extent[0] * u, y + extent[1] * v, z]);
            beams.push({ near: true, x0, y0, h: -z0, n, power, axis: rows.map((row) => row[2]), light, colour });
          } else beams.push({ near: false, ax: from[k].ax, ay: from[k].ay, n, power: (power * from[k].part) / area, light, colour });
        }
      });
    });
  }
  return beams;
}

/** By how much the grid is thinned out: many beams make a smooth image, of which coarser cells are enough; rays that the page holds
 * have them already. */
const thinning = (beams) => (beams <= 4 || held.lights[0].rays ? 1 : beams <= 48 ? 2 : 4);

// ---- tracing on the processor

/** Rows of corners: landing points, places on the entrance and in the pupil, power per area; px is NaN where no light leaves. */
const cornerRow = (length) => ["px", "py", "ex", "ey", "qx", "qy", "w"].reduce((row, name) => ({ ...row, [name]: new Float64Array(length) }), {});

/** Part of unpolarised light reflected, of cosines c before and s behind a surface, eta = n before over n behind. */
function reflectance(kind, c, s, eta) {
  if (kind === FRESNEL.exact) {
    return 0.5 * (square((eta * c - s) / (eta * c + s)) + square((c - eta * s) / (c + eta * s)));
  }
  const r0 = square((eta - 1) / (eta + 1)), x = 1 - (eta > 1 ? s : c);
  return r0 + (1 - r0) * x * x * x * x * x;
}

/** Power per solid angle of a near source towards a direction, 1/sr. */
function intensity(beam, ax, ay, az) {
  const { light, axis } = beam, last = light.intensity.length - 1;
  const s = Math.sqrt(square(ax - axis[0]) + square(ay - axis[1]) + square(az - axis[2])) / light.chord;
  if (s > 1 + 1e-9) return light.cut ? 0 : light.intensity[last];
  const at = Math.min(s * last, last - 1e-6), k = Math.floor(at);
  return light.intensity[k] + (at - k) * (light.intensity[k + 1] - light.intensity[k]);
}

/** x and y of the screen's centre where that is at z: it moves along the light. */
const centreAt = (z) => held.screen.centre.map((c, k) => c + (z - held.screen.z) * held.screen.along[k]);

/** Coordinates of the centre of a far screen along its axes. */
const farCentre = () => held.screen.axes.slice(0, 2).map((a) => a[0] * held.screen.centre[0] + a[1] * held.screen.centre[1] + a[2] * held.screen.z);

/** A surface as a function of x, y that tells `at` its height s, slopes sx, sy and their derivatives: a plane z = s, or a grid,
 * linear between its points and beyond its border. */
const flatAt = (s) => (x, y, at) => { at.s = s; at.sx = at.sy = at.sxx = at.sxy = at.syy = 0; };
function gridAt({ nx, ny, z, zx, zy, reach: [rx, ry] }) {
  const hx = (2 * rx) / (nx - 1), hy = (2 * ry) / (ny - 1);
  return (x, y, at) => {
    const u = (x + rx) / hx, v = (y + ry) / hy;
    const i = Math.min(nx - 2, Math.max(0, Math.floor(u))), j = Math.min(ny - 2, Math.max(0, Math.floor(v))), k = i * ny + j;
    const f = u - i, g = v - j, a = (1 - f) * (1 - g), b = f * (1 - g), c = (1 - f) * g, d = f * g, l = k + ny;
    at.s = a * z[k] + b * z[l] + c * z[k + 1] + d * z[l + 1];
    at.sx = a * zx[k] + b * zx[l] + c * zx[k + 1] + d * zx[l + 1];
    at.sy = a * zy[k] + b * zy[l] + c * zy[k + 1] + d * zy[l + 1];
    at.sxx = ((1 - g) * (zx[l] - zx[k]) + g * (zx[l + 1] - zx[k + 1])) / hx;
    at.syy = ((1 - f) * (zy[k + 1] - zy[k]) + f * (zy[l + 1] - zy[l])) / hy;
    at.sxy = 0.5 * (((1 - f) * (zx[k + 1] - zx[k]) + f * (zx[l + 1] - zx[l])) / hy + ((1 - g) * (zy[l] - zy[k]) + g * (zy[l + 1] - zy[k + 1])) / hx);
  };
}

/** The entrance of a lens as a function that finds how the light of a beam reaches a point of the exit: a, d, e, q and glass of `ray`,
 * the power w per area of the pupil, and `lost`, the part that the entrance reflects. */
function entranceOf(cloud) {
  const { lens } = held, surface = cloud.entrance ? gridAt(cloud.entrance) : flatAt(lens.zIn), wave = {};
  const fronts = new Map(held.lights.map((light) => [light, light.grid && gridAt(light.grid)])); // of irradiance, and sines to the axis
  return (beam, x, y, z, ray) => {
    const front = fronts.get(beam.light);
    const { n, near, x0, y0, h } = beam, z0 = lens.zIn - h, t = z - lens.zIn;
    let ax = beam.ax, ay = beam.ay, az = near ? 1 : Math.sqrt(1 - ax * ax - ay * ay), away = 0; // 1 / distance from the source, negative before a focus
    let ex = near ? (x * h + x0 * (t / n)) / (h + t / n) : x - (t * ax) / Math.sqrt(n * n - ax * ax - ay * ay);
    let ey = near ? (y * h + y0 * (t / n)) / (h + t / n) : y - (t * ay) / Math.sqrt(n * n - ax * ax - ay * ay);
    for (let step = 0; ; step++) {
      surface(ex, ey, ray);
      if (near) {
        ax = ex - x0; ay = ey - y0; az = ray.s - z0;
        away = Math.sign(h) / Math.sqrt(ax * ax + ay * ay + az * az);
        ax *= away; ay *= away; az *= away;
      } else if (front) {
        front(ex, ey, wave);
        ax = beam.ax + wave.sx; ay = beam.ay + wave.sy; az = Math.sqrt(1 - ax * ax - ay * ay);
      }
      if (n === 1 || step === STEPS) break; // the straight path is exact without refraction
      let dx = x - ex, dy = y - ey, dz = z - ray.s;
      const r = 1 / Math.sqrt(dx * dx + dy * dy + dz * dz), { sx, sy } = ray;
      dx *= r; dy *= r; dz *= r;
      const gz = az - n * dz, gx = ax - n * dx + gz * sx, gy = ay - n * dy + gz * sy; // the optical path's gradient by e, its Hessian
      const au = ax + az * sx, av = ay + az * sy, du = dx + dz * sx, dv = dy + dz * sy;
      let hxx = away * (1 + sx * sx - au * au) + n * r * (1 + sx * sx - du * du) + gz * ray.sxx;
      let hyy = away * (1 + sy * sy - av * av) + n * r * (1 + sy * sy - dv * dv) + gz * ray.syy;
      let hxy = away * (sx * sy - au * av) + n * r * (sx * sy - du * dv) + gz * ray.sxy;
      if (front && !near) { hxx += wave.sxx; hyy += wave.syy; hxy += wave.sxy; }
      const det = hxx * hyy - hxy * hxy, mx = (hyy * gx - hxy * gy) / det, my = (hxx * gy - hxy * gx) / det;
      ex -= mx; ey -= my;
      if (mx * mx + my * my < FINE * FINE) step = STEPS - 1;
    }
    const { s, sx, sy } = ray, norm2 = 1 + sx * sx + sy * sy, c = az - ax * sx - ay * sy, root = Math.sqrt(c * c + (n * n - 1) * norm2);
    const gamma = (n * n - 1) / (root + c); // n d = a + gamma N, N = (-sx, -sy, 1)
    ray.dx = (ax - gamma * sx) / n; ray.dy = (ay - gamma * sy) / n; ray.dz = (az + gamma) / n;
    ray.ex = ex; ray.ey = ey; ray.glass = (z - s) / ray.dz;
    ray.qx = ex + ((lens.zIn - s) * ax) / az; ray.qy = ey + ((lens.zIn - s) * ay) / az;
    ray.w = near ? (intensity(beam, ax, ay, az) * az * az * az) / (h * h) : 1;
    if (front) { front(ray.qx, ray.qy, wave); ray.w *= wave.s; }
    ray.lost = lens.fresnel && n > 1 ? reflectance(lens.fresnel, c / Math.sqrt(norm2), root / (n * Math.sqrt(norm2)), 1 / n) : 0;
  };
}

/** The screen at z as a function that finds the landing point of light from a point along a unit direction, in pixels, px is NaN where
 * it does not arrive: on a plane, on a surface whose heights over that are a grid, or by direction alone. */
function screenAt(cloud, z) {
  const { axes: [[ux, uy, uz], [vx, vy, vz], [nx, ny, nz]], low, pixel, focal, facing } = held.screen;
  const [mx, my] = centreAt(z), shape = cloud.shape && gridAt(cloud.shape), at = {};
  const land = (px, py, arrives, row, b) => { row.px[b] = arrives ? (px - low[0]) / pixel[0] : NaN; row.py[b] = (py - low[1]) / pixel[1]; };
  if (focal) {
    const [cx, cy] = farCentre();
    return (x, y, height, ox, oy, oz, row, b) => land(focal * (ox * ux + oy * uy + oz * uz) - cx, focal * (ox * vx + oy * vy + oz * vz) - cy,
      (ox * nx + oy * ny + oz * nz > 0) === facing, row, b);
  }
  return (x, y, height, ox, oy, oz, row, b) => {
    const along = ox * nx + oy * ny + oz * nz, way = ((z - height) * nz - (x - mx) * nx - (y - my) * ny) / along;
    const qx = x - mx + way * ox, qy = y - my + way * oy, qz = height + way * oz - z;
    const px = qx * ux + qy * uy + qz * uz, py = qx * vx + qy * vy + qz * vz;
    if (!shape) { land(px, py, way > 0, row, b); return; }
    const kx = (ox * ux + oy * uy + oz * uz) / along, ky = (ox * vx + oy * vy + oz * vz) / along;
    let high = 0, steep = 1; // above the tangent plane; how fast the ray nears the surface
    for (let step = 0; step < STEPS; step++) {
      shape(px + high * kx, py + high * ky, at);
      steep = 1 - at.sx * kx - at.sy * ky;
      const move = (high - at.s) / steep;
      high -= move;
      if (Math.abs(move) < FINE) break;
    }
    land(px + high * kx, py + high * ky, way + high / along > 0 && steep > 0, row, b);
  };
}

/** A function that traces the corners of row i of the grid, every `thin`-th point, into `row`; the screen is at z. */
function rowTracer(cloud, z, thin) {
  const { lens } = held, { fresnel } = lens, { ny } = cloud, [rx, ry] = lens.size.map((s) => s / 2);
  const enter = entranceOf(cloud), meet = screenAt(cloud, z), ray = {};
  /** The corners of a row of light that the page holds behind the last surface. */
  const takeRow = ({ rays, power }, i, x, row) => {
    for (let j = 0, b = 0; j < ny; j += thin, b++) {
      const k = i * ny + j, ox = rays.ox[k], oy = rays.oy[k];
      meet(rays.x[k], rays.y[k], rays.z, ox, oy, rays.ahead * Math.sqrt(1 - ox * ox - oy * oy), row, b);
      row.ex[b] = row.qx[b] = x; row.ey[b] = row.qy[b] = (2 * j / (ny - 1) - 1) * ry; row.w[b] = rays.w[k] * power;
    }
  };
  return (beam, i, row) => {
    const x = (2 * i / (cloud.nx - 1) - 1) * rx, { n } = beam;
    if (beam.rays) { takeRow(beam, i, x, row); return; }
    for (let j = 0, b = 0; j < ny; j += thin, b++) {
      const k = i * ny + j, y = (2 * j / (ny - 1) - 1) * ry, zx = cloud.zx[k], zy = cloud.zy[k], height = cloud.z[k];
      enter(beam, x, y, height, ray);
      const { dx, dy, dz } = ray;
      let w = ray.w * beam.power;
      // the exit: N = (-zx, -zy, 1), c = d . N, s = t . N
      const norm2 = 1 + zx * zx + zy * zy, c = dz - dx * zx - dy * zy;
      let ox, oy, oz;
      if (lens.mirror) {
        const twice = (2 * c) / norm2;
        ox = dx + twice * zx; oy = dy + twice * zy; oz = dz - twice;
      } else {
        const radicand = norm2 + n * n * (c * c - norm2);
        if (!(radicand > 0)) { row.px[b] = NaN; continue; } // total internal reflection
        const s = Math.sqrt(radicand), gamma = ((1 - n) * (1 + n)) / (s + n * c);
        ox = n * dx - gamma * zx; oy = n * dy - gamma * zy; oz = n * dz + gamma;
        if (fresnel) {
          const length = fresnel === FRESNEL.schlick ? Math.sqrt(norm2) : 1;
          w *= (1 - ray.lost) * (1 - reflectance(fresnel, c / length, s / length, n));
        }
        if (lens.absorption) w *= Math.exp(-lens.absorption * ray.glass);
      }
      meet(x, y, height, ox, oy, oz, row, b);
      row.ex[b] = ray.ex; row.ey[b] = ray.ey; row.qx[b] = ray.qx; row.qy[b] = ray.qy; row.w[b] = w;
    }
  };
}

/** Part of a cell of rows p and q, corners b and c = b + 1, with its middle at x, y on the exit, that exit, entrance and pupil pass. */
function passed(p, q, b, c, x, y) {
  const [rx, ry] = held.lens.size.map((s) => s / 2);
  const part = (ex, ey) => {
    const e0 = 0.5 * (p[ex][b] + p[ex][c]), f0 = 0.5 * (q[ex][b] + q[ex][c]), e1 = 0.5 * (p[ey][b] + q[ey][b]), f1 = 0.5 * (p[ey][c] + q[ey][c]);
    if (!held.lens.round) return within(e0, f0, rx) * within(e1, f1, ry);
    return Math.min(1, Math.max(0, 0.5 + (rx - Math.max(Math.hypot(x, y), 0.5 * Math.hypot(e0 + f0, e1 + f1))) / Math.sqrt(Math.abs((f0 - e0) * (f1 - e1)))));
  };
  return Math.min(part("ex", "ey"), part("qx", "qy"));
}

/** Part of the way from e to f that lies within +-r. */
const within = (e, f, r) => Math.min(1, Math.max(0, (Math.min(Math.max(e, f), r) - Math.max(Math.min(e, f), -r)) / Math.abs(f - e)));

/** Share out the light of the cells between two rows of corners among the pixels; x: of their middles, dy: their width along y. */
function splatRow(p, q, x, dy, count, image) {
  const [mx, my] = held.screen.resolution, ry = held.lens.size[1] / 2;
  for (let b = 0; b + 1 < count; b++) {
    const c = b + 1;
    const cx = 0.25 * (p.px[b] + p.px[c] + q.px[b] + q.px[c]), cy = 0.25 * (p.py[b] + p.py[c] + q.py[b] + q.py[c]);
    if (!(cx > -1e6 && cx < 1e6 && cy > -1e6 && cy < 1e6)) continue; // also NaN
    const w = 0.25 * (p.w[b] + p.w[c] + q.w[b] + q.w[c]) * passed(p, q, b, c, x, (b + 0.5) * dy - ry);
    if (!(w > 0)) continue;
    const area = 0.5 * Math.abs((q.qx[c] - p.qx[b]) * (q.qy[b] - p.qy[c]) - (q.qx[b] - p.qx[c]) * (q.qy[c] - p.qy[b]));
    const wide = Math.max(SMALLEST, 0.5 * Math.sqrt(square(q.px[b] + q.px[c] - p.px[b] - p.px[c]) + square(p.px[c] + q.px[c] - p.px[b] - q.px[b])));
    const tall = Math.max(SMALLEST, 0.5 * Math.sqrt(square(q.py[b] + q.py[c] - p.py[b] - p.py[c]) + square(p.py[c] + q.py[c] - p.py[b] - q.py[b])));
    const x0 = cx - 0.5 * wide, x1 = cx + 0.5 * wide, y0 = cy - 0.5 * tall, y1 = cy + 0.5 * tall;
    const i1 = Math.min(mx, Math.ceil(x1)), j0 = Math.max(0, Math.floor(y0)), j1 = Math.min(my, Math.ceil(y1)), each = (w * area) / (wide * tall);
    for (let i = Math.max(0, Math.floor(x0)); i < i1; i++) {
      const part = each * (Math.min(x1, i + 1) - Math.max(x0, i));
      for (let j = j0; j < j1; j++) image[i * my + j] += part * (Math.min(y1, j + 1) - Math.max(y0, j));
    }
  }
}

/** The image of beams on a screen at z, a part of all power for each pixel; a generator that stops after every row. */
function* tracedHere(cloud, beams, z, thin) {
  const [mx, my] = held.screen.resolution, image = new Float64Array(mx * my), count = (cloud.ny - 1) / thin + 1;
  const [dx, dy] = [held.lens.size[0] / (cloud.nx - 1), held.lens.size[1] / (cloud.ny - 1)].map((d) => d * thin);
  const traceRow = rowTracer(cloud, z, thin);
  let before = cornerRow(count), now = cornerRow(count);
  for (const beam of beams) {
    for (let i = 0; i < cloud.nx; i += thin) {
      traceRow(beam, i, now);
      if (i > 0) splatRow(before, now, (i / thin - 0.5) * dx - held.lens.size[0] / 2, dy, count, image);
      [before, now] = [now, before];
      yield;
    }
  }
  return image;
}

// ---- tracing on the graphics processor

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D cloud, table, entrance, shape, front; uniform ivec2 points; uniform int thin;
uniform bool near, isRound, isMirror, cut, bent, curved, uneven; uniform int fresnel;
uniform vec3 origin, axis, u, v, normal; uniform vec2 direction, radius, middle, low, pixel, reach, offset; uniform vec4 frame;
uniform float n, power, zIn, absorption, chord, z, largest, smallest, focal, forward;
flat out vec4 box; flat out float each;
float reflectance(float c, float s, float eta) {
  if (fresnel == 2) { float a = (eta * c - s) / (eta * c + s), b = (c - eta * s) / (c + eta * s); return 0.5 * (a * a + b * b); }
  float r = (eta - 1.0) / (eta + 1.0), x = 1.0 - (eta > 1.0 ? s : c);
  return r * r + (1.0 - r * r) * x * x * x * x * x;
}
float intensity(vec3 a) {
  int last = textureSize(table, 0).x - 1; float s = length(a - axis) / chord;
  if (s > 1.0 + 1e-6) return cut ? 0.0 : texelFetch(table, ivec2(last, 0), 0).r;
  float at = min(s * float(last), float(last) - 1e-3); int k = int(at);
  return mix(texelFetch(table, ivec2(k, 0), 0).r, texelFetch(table, ivec2(k + 1, 0), 0).r, at - float(k));
}
vec3 onGrid(sampler2D grid, vec2 reach, vec2 at, out vec3 bend) {
  vec2 last = vec2(textureSize(grid, 0).yx - 1), size = 2.0 * reach / last, place = (at + reach) / size;
  vec2 cell = clamp(floor(place), vec2(0.0), last - 1.0), f = place - cell; ivec2 k = ivec2(cell);
  vec3 a = texelFetch(grid, k.yx, 0).xyz, b = texelFetch(grid, k.yx + ivec2(0, 1), 0).xyz;
  vec3 c = texelFetch(grid, k.yx + ivec2(1, 0), 0).xyz, d = texelFetch(grid, k.yx + 1, 0).xyz;
  vec3 along = mix(b - a, d - c, f.y) / size.x, upward = mix(c - a, d - b, f.x) / size.y;
  bend = vec3(along.y, 0.5 * (along.z + upward.y), upward.z);
  return mix(mix(a, b, f.x), mix(c, d, f.x), f.y);
}
void enter(vec3 to, out vec3 d, out vec2 e, out vec2 q, out float w, out float lost, out float glass) {
  float h = origin.z, t = to.z - zIn, away = 0.0; vec3 a = vec3(direction, near ? 1.0 : sqrt(1.0 - dot(direction, direction)));
  e = near ? (to.xy * h + origin.xy * (t / n)) / (h + t / n) : to.xy - t * direction / sqrt(n * n - dot(direction, direction));
  vec3 p = vec3(zIn, 0.0, 0.0), bend = vec3(0.0), curl = vec3(0.0);
  for (int step = 0; ; step++) {
    if (bent) p = onGrid(entrance, radius, e, bend);
    if (near) { vec2 side = e - origin.xy; float up = p.x - zIn + h; away = sign(h) * inversesqrt(dot(side, side) + up * up); a = vec3(side, up) * away; }
    else if (uneven) { a.xy = direction + onGrid(front, radius, e, curl).yz; a.z = sqrt(1.0 - dot(a.xy, a.xy)); }
    if (n == 1.0 || step == 6) break;
    vec3 way = to - vec3(e, p.x); float r = inversesqrt(dot(way, way)); way *= r;
    float gz = a.z - n * way.z; vec2 g = a.xy - n * way.xy + gz * p.yz, s = a.xy + a.z * p.yz, o = way.xy + way.z * p.yz;
    vec3 hessian = away * vec3(1.0 + p.y * p.y - s.x * s.x, p.y * p.z - s.x * s.y, 1.0 + p.z * p.z - s.y * s.y)
      + n * r * vec3(1.0 + p.y * p.y - o.x * o.x, p.y * p.z - o.x * o.y, 1.0 + p.z * p.z - o.y * o.y) + gz * bend + curl;
    e -= vec2(hessian.z * g.x - hessian.y * g.y, hessian.x * g.y - hessian.y * g.x) / (hessian.x * hessian.z - hessian.y * hessian.y);
  }
  float norm2 = 1.0 + dot(p.yz, p.yz), c = a.z - dot(a.xy, p.yz), denser = (n - 1.0) * (n + 1.0), root = sqrt(c * c + denser * norm2);
  d = (a + denser / (root + c) * vec3(-p.yz, 1.0)) / n;
  glass = (to.z - p.x) / d.z;
  if (!bent) e = to.xy - glass * d.xy; // from the exit: differences of near numbers
  q = e + (zIn - p.x) / a.z * a.xy;
  w = near ? intensity(a) * a.z * (a.z / h) * (a.z / h) : 1.0;
  if (uneven) w *= onGrid(front, radius, q, curl).x;
  lost = fresnel > 0 && n > 1.0 ? reflectance(c / sqrt(norm2), root / (n * sqrt(norm2)), 1.0 / n) : 0.0;
}
bool meet(vec3 from, vec3 o, out vec2 landing) {
  float along = dot(o, normal); vec2 at = vec2(dot(o, u), dot(o, v));
  if (focal > 0.0) { landing = (focal * at - offset - low) / pixel; return along * forward > 0.0; }
  float way = -dot(from, normal) / along, high = 0.0, steep = 1.0; vec3 q = from + way * o; vec2 base = vec2(dot(q, u), dot(q, v));
  if (curved) for (int step = 0; step < 8; step++) {
    vec3 bend, p = onGrid(shape, reach, base + high * at / along, bend);
    steep = 1.0 - dot(p.yz, at) / along; high -= (high - p.x) / steep;
  }
  landing = (base + high * at / along - low) / pixel;
  return way + high / along > 0.0 && steep > 0.0;
}
bool corner(ivec2 at, out vec2 landing, out vec2 e, out vec2 q, out float w) {
  vec4 p = texelFetch(cloud, at.yx, 0);
  vec2 xy = (2.0 * vec2(at) / vec2(points - 1) - 1.0) * radius;
  vec3 d; float lost, glass;
  enter(vec3(xy, p.x), d, e, q, w, lost, glass);
  w *= power;
  float norm2 = 1.0 + dot(p.yz, p.yz), c = d.z - dot(d.xy, p.yz); vec3 o;
  if (isMirror) { float twice = 2.0 * c / norm2; o = vec3(d.xy + twice * p.yz, d.z - twice); }
  else {
    float radicand = norm2 + n * n * (c * c - norm2);
    if (!(radicand > 0.0)) return false;
    float s = sqrt(radicand), gamma = (1.0 - n) * (1.0 + n) / (s + n * c);
    o = vec3(n * d.xy - gamma * p.yz, n * d.z + gamma);
    if (fresnel > 0) { float l = fresnel == 1 ? sqrt(norm2) : 1.0; w *= (1.0 - lost) * (1.0 - reflectance(c / l, s / l, n)); }
    if (absorption > 0.0) w *= exp(-absorption * glass);
  }
  return meet(vec3(xy - middle, p.x - z), o, landing);
}
float passed(vec2 exit, vec2 e, vec2 f) {
  vec2 part = clamp((min(max(e, f), radius) - max(min(e, f), -radius)) / abs(f - e), 0.0, 1.0);
  if (!isRound) return part.x * part.y;
  float side = sqrt(abs((f.x - e.x) * (f.y - e.y)));
  return clamp(0.5 + (radius.x - max(length(exit), 0.5 * length(e + f))) / side, 0.0, 1.0);
}
void main() {
  int along = (points.y - 1) / thin; ivec2 at = ivec2(gl_VertexID / along, gl_VertexID % along) * thin;
  vec2 a, b, c, d, ea, eb, ec, ed, qa, qb, qc, qd; float wa, wb, wc, wd;
  bool lit = corner(at, a, ea, qa, wa); lit = corner(at + ivec2(0, thin), b, eb, qb, wb) && lit;
  lit = corner(at + ivec2(thin, 0), c, ec, qc, wc) && lit; lit = corner(at + thin, d, ed, qd, wd) && lit;
  vec2 centre = 0.25 * (a + b + c + d), across = c + d - a - b, upward = b + d - a - c;
  vec2 sides = clamp(0.5 * sqrt(across * across + upward * upward), vec2(smallest), vec2(largest));
  vec2 g = qd - qa, f = qc - qb; float area = 0.5 * abs(g.x * f.y - f.x * g.y);
  vec2 exit = ((2.0 * vec2(at) + float(thin)) / vec2(points - 1) - 1.0) * radius;
  float share = passed(exit, 0.5 * vec2(qa.x + qb.x, qa.y + qc.y), 0.5 * vec2(qc.x + qd.x, qb.y + qd.y));
  if (bent) share = min(share, passed(exit, 0.5 * vec2(ea.x + eb.x, ea.y + ec.y), 0.5 * vec2(ec.x + ed.x, eb.y + ed.y)));
  each = 0.25 * (wa + wb + wc + wd) * share * area / (sides.x * sides.y);
  box = vec4(centre - 0.5 * sides, centre + 0.5 * sides);
  lit = lit && each > 0.0 && all(lessThan(abs(centre), vec2(1e6)));
  gl_Position = lit ? vec4((centre + frame.z) / frame.xy * 2.0 - 1.0, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = max(sides.x, sides.y) + 1.2; // its place is rounded to a sixteenth of a pixel on some processors
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 frame; flat in vec4 box; flat in float each; out vec4 light;
void main() {
  vec2 pixel = floor(gl_FragCoord.xy) - frame.z, part = min(box.zw, pixel + 1.0) - max(box.xy, pixel);
  light = vec4(part.x > 0.0 && part.y > 0.0 ? each * part.x * part.y : 0.0, 0.0, 0.0, 0.0);
}`;

/** A tracer on the graphics processor, or null where there is none that adds up floating-point numbers. */
function graphicsTracer(cloud, slowToo) {
  const gl = document.createElement("canvas").getContext("webgl2", { antialias: false, failIfMajorPerformanceCaveat: !slowToo });
  if (!gl || !gl.getExtension("EXT_color_buffer_float") || !gl.getExtension("EXT_float_blend")) return null;
  const [mx, my] = held.screen.resolution, wide = mx + 2 * MARGIN, tall = my + 2 * MARGIN;
  if (Math.max(cloud.nx, cloud.ny, wide, tall) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) return null;
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  const at = (name) => gl.getUniformLocation(program, name);
  const texture = (unit, format, width, height, layout, values) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, layout, gl.FLOAT, values);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    return made;
  };
  const surface = (unit, grid) => {
    const texels = new Float32Array(4 * grid.z.length);
    for (let k = 0; k < grid.z.length; k++) texels.set([grid.z[k], grid.zx[k], grid.zy[k], 1], 4 * k);
    return texture(unit, gl.RGBA32F, grid.ny, grid.nx, gl.RGBA, texels);
  };
  surface(0, cloud);
  if (cloud.entrance) surface(3, cloud.entrance);
  if (cloud.shape) surface(4, cloud.shape);
  const tables = held.lights.map((light) => light.near && texture(1, gl.R32F, light.intensity.length, 1, gl.RED, new Float32Array(light.intensity)));
  const fronts = held.lights.map((light) => light.grid && surface(5, light.grid));
  const sum = texture(2, gl.RGBA32F, wide, tall, gl.RGBA, null);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sum, 0);
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) return null;
  gl.activeTexture(gl.TEXTURE2);
  gl.bindTexture(gl.TEXTURE_2D, null);
  const { lens, screen } = held;
  gl.viewport(0, 0, wide, tall);
  gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE); gl.disable(gl.DEPTH_TEST);
  gl.uniform1i(at("cloud"), 0); gl.uniform1i(at("table"), 1); gl.uniform1i(at("entrance"), 3); gl.uniform1i(at("shape"), 4); gl.uniform1i(at("front"), 5);
  gl.uniform1i(at("bent"), Boolean(cloud.entrance)); gl.uniform1i(at("curved"), Boolean(cloud.shape));
  if (cloud.shape) gl.uniform2f(at("reach"), ...cloud.shape.reach);
  gl.uniform1f(at("focal"), screen.focal); gl.uniform1f(at("forward"), screen.facing ? 1 : -1); gl.uniform2f(at("offset"), ...farCentre());
  gl.uniform2i(at("points"), cloud.nx, cloud.ny);
  gl.uniform1i(at("isRound"), lens.round); gl.uniform1i(at("isMirror"), lens.mirror); gl.uniform1i(at("fresnel"), lens.fresnel);
  gl.uniform2f(at("radius"), ...cloud.reach); gl.uniform2f(at("low"), ...screen.low); gl.uniform2f(at("pixel"), ...screen.pixel);
  gl.uniform3f(at("u"), ...screen.axes[0]); gl.uniform3f(at("v"), ...screen.axes[1]); gl.uniform3f(at("normal"), ...screen.axes[2]);
  gl.uniform4f(at("frame"), wide, tall, MARGIN, 0);
  gl.uniform1f(at("zIn"), lens.zIn); gl.uniform1f(at("absorption"), lens.absorption);
  gl.uniform1f(at("smallest"), SMALLEST); gl.uniform1f(at("largest"), gl.getParameter(gl.ALIASED_POINT_SIZE_RANGE)[1] - 2);
  const told = gl.getExtension("WEBGL_debug_renderer_info"), name = told ? String(gl.getParameter(told.UNMASKED_RENDERER_WEBGL)) : "";
  const where = Object.fromEntries(["near", "uneven", "origin", "axis", "cut", "chord", "direction", "n", "power", "z", "middle", "thin"].map((key) => [key, at(key)]));

  function* traced(beams, z, thin) {
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT);
    for (const beam of beams) {
      gl.uniform1i(where.near, beam.near); gl.uniform1f(where.n, beam.n); gl.uniform1f(where.power, beam.power);
      gl.uniform1f(where.z, z); gl.uniform2f(where.middle, ...centreAt(z)); gl.uniform1i(where.thin, thin);
      if (beam.near) {
        gl.uniform3f(where.origin, beam.x0, beam.y0, beam.h); gl.uniform3f(where.axis, ...beam.axis);
        gl.uniform1i(where.cut, beam.light.cut); gl.uniform1f(where.chord, beam.light.chord);
        gl.activeTexture(gl.TEXTURE1); gl.bindTexture(gl.TEXTURE_2D, tables[held.lights.indexOf(beam.light)]);
      } else gl.uniform2f(where.direction, beam.ax, beam.ay);
      gl.uniform1i(where.uneven, Boolean(beam.light.grid));
      gl.activeTexture(gl.TEXTURE5); gl.bindTexture(gl.TEXTURE_2D, fronts[held.lights.indexOf(beam.light)]);
      gl.drawArrays(gl.POINTS, 0, ((cloud.nx - 1) / thin) * ((cloud.ny - 1) / thin));
      gl.flush();
      yield;
    }
    const read = new Float32Array(4 * mx * my), image = new Float64Array(mx * my);
    gl.readPixels(MARGIN, MARGIN, mx, my, gl.RGBA, gl.FLOAT, read);
    if (gl.getError() !== gl.NO_ERROR) throw new Error("the graphics processor gave up");
    for (let j = 0; j < my; j++) for (let i = 0; i < mx; i++) image[i * my + j] = read[4 * (j * mx + i)];
    return image;
  }
  return { traced, name };
}

// ---- pictures

const sum = (values) => values.reduce((a, b) => a + b, 0);
const most = (values) => values.reduce((a, b) => Math.max(a, b), 0);
const LUMINANCE = [0.2126390, 0.7151687, 0.0721923]; // of linear sRGB
const srgb = (v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);

/** Paint a canvas from a function of the pixel's index that gives red, green and blue, 0 to 255. */
function paint(canvas, colour) {
  const [mx, my] = held.screen.resolution;
  canvas.width = mx; canvas.height = my;
  canvas.style.aspectRatio = `${mx * held.screen.pixel[0]} / ${my * held.screen.pixel[1]}`;
  const context = canvas.getContext("2d"), picture = context.createImageData(mx, my);
  for (let i = 0; i < mx; i++) {
    for (let j = 0; j < my; j++) picture.data.set([...colour(i * my + j), 255], 4 * ((my - 1 - j) * mx + i));
  }
  context.putImageData(picture, 0, 0);
}

const clamped = (v) => Math.min(1, Math.max(0, v));

/** Linear red, green and blue moved towards the grey of their luminance until all are 0 to 1. */
function intoGamut(rgb) {
  const grey = clamped(rgb.reduce((all, v, c) => all + LUMINANCE[c] * v, 0));
  const kept = Math.min(1, ...rgb.map((v) => (v > grey ? (1 - grey) / (v - grey) : v < grey ? grey / (grey - v) : 1)));
  return rgb.map((v) => clamped(grey + kept * (v - grey)));
}

/** Areas of the screen's pixels over those of a plane one; null for a plane one. */
function areasOf(shape) {
  if (!shape) return null;
  const { resolution: [mx, my], low, pixel } = held.screen, surface = gridAt(shape), at = {}, areas = new Float64Array(mx * my);
  for (let i = 0; i < mx; i++) {
    for (let j = 0; j < my; j++) {
      surface(low[0] + (i + 0.5) * pixel[0], low[1] + (j + 0.5) * pixel[1], at);
      areas[i * my + j] = Math.sqrt(1 + at.sx * at.sx + at.sy * at.sy);
    }
  }
  return areas;
}

/** Show irradiance as render.png does: white is the target's greatest at the image's power; in colour where `planes` of linear red,
 * green and blue are given. */
function paintLight(canvas, image, white, planes = null) {
  const shown = (k) => (planes ? intoGamut(planes.map((plane) => plane[k] / (white || 1))) : Array(3).fill(clamped(image[k] / (white || 1))));
  paint(canvas, (k) => shown(k).map((v) => 255 * (held.encoding === "srgb" ? srgb(v) : v)));
}

/** Blue below 0, red above, to +-1. */
function paintDifference(canvas, error) {
  paint(canvas, (k) => {
    const e = Math.max(-1, Math.min(1, error[k])), f = Math.abs(e) ** 0.8, end = e < 0 ? [43, 87, 196] : [179, 38, 30];
    return end.map((c) => 232 + f * (c - 232));
  });
}

/** Each over its own mean: the difference, and its root mean square. */
function compared(image, target) {
  const light = sum(image) || 1, goal = sum(target), count = image.length;
  const error = Float64Array.from(image, (v, k) => (v / light - target[k] / goal) * count);
  return { error, rms: Math.sqrt(error.reduce((a, e) => a + e * e, 0) / count) };
}

// ---- the lens in three dimensions: its points, drawn one by one with their depth

function solidView(canvas, cloud) {
  const { lens } = held, [rx, ry] = lens.size.map((s) => s / 2), { nx, ny } = cloud, count = nx * ny;
  const view = { yaw: -0.5, pitch: lens.mirror ? Math.PI - 0.95 : -0.95, zoom: 1, relief: 1 };
  const xs = Float64Array.from({ length: nx }, (_, i) => (2 * i / (nx - 1) - 1) * rx);
  const ys = Float64Array.from({ length: ny }, (_, j) => (2 * j / (ny - 1) - 1) * ry);
  const q0 = sum(xs.map(square)) / nx + sum(ys.map(square)) / ny, size = Math.hypot(2 * rx, 2 * ry);
  /** A side, about its least-squares fit by 1, x, y and x^2 + y^2 less its mean, which are orthogonal on this grid: its middle c0, its
   * roughness, heights and slopes at a point with the departure from the fit `k` times as deep. */
  const sideOf = (grid) => {
    const dots = [0, 0, 0, 0], norms = [0, 0, 0, 0];
    for (let i = 0, k = 0; i < nx; i++) {
      for (let j = 0; j < ny; j++, k++) [1, xs[i], ys[j], square(xs[i]) + square(ys[j]) - q0].forEach((b, m) => { dots[m] += b * grid.z[k]; norms[m] += b * b; });
    }
    const [c0, cx, cy, cq] = dots.map((d, m) => d / norms[m]);
    let rough = 0;
    for (let i = 0, k = 0; i < nx; i++) {
      for (let j = 0; j < ny; j++, k++) rough += square(grid.zx[k] - cx - 2 * cq * xs[i]) + square(grid.zy[k] - cy - 2 * cq * ys[j]);
    }
    const height = (i, j, k) => { const f = c0 + cx * xs[i] + cy * ys[j] + cq * (square(xs[i]) + square(ys[j]) - q0); return f + k * (grid.z[i * ny + j] - f); };
    const slopes = (i, j, k) => [[grid.zx, cx, xs[i]], [grid.zy, cy, ys[j]]].map(([of, c, x]) => { const f = c + 2 * cq * x; return f + k * (of[i * ny + j] - f); });
    return { c0, rough: Math.sqrt(rough / count), height, slopes };
  };
  const exit = sideOf(cloud), { c0 } = exit, flat = lens.mirror ? most(cloud.z) + 0.2 * Math.max(...lens.size) : lens.zIn;
  const entrance = cloud.entrance ? sideOf(cloud.entrance) : { c0: flat, rough: 0, height: () => flat, slopes: () => [0, 0] };
  const usual = Math.min(DEEPEST, Math.max(1, 0.25 / (Math.max(exit.rough, entrance.rough) || 1)));

  function draw() {
    if (!canvas.clientWidth) return;
    const ratio = Math.min(2, window.devicePixelRatio || 1), finer = moving ? 1 : 2; // than the canvas, for smooth edges
    canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.width * 0.75);
    const width = finer * canvas.width, height = finer * canvas.height;
    const picture = new ImageData(width, height), out = new Uint32Array(picture.data.buffer);
    const depth = new Float32Array(width * height).fill(-Infinity), k = view.relief, dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const ca = Math.cos(view.yaw), sa = Math.sin(view.yaw), cb = Math.cos(view.pitch), sb = Math.sin(view.pitch);
    const axes = [[ca, -sa, 0], [sa * cb, ca * cb, -sb], [sa * sb, ca * sb, cb]]; // right, up and towards the eye
    const scale = (0.86 * height * view.zoom) / size, middle = 0.5 * (c0 + entrance.c0);
    const light = [-0.45, 0.6, 0.66], half = [-0.25, 0.33, 0.91]; // to the lamp, and halfway from there to the eye
    const shade = (gx, gy, gz) => {
      const l = 1 / Math.sqrt(gx * gx + gy * gy + gz * gz), e = axes.map((a) => (a[0] * gx + a[1] * gy + a[2] * gz) * l);
      const d = Math.max(0, e[0] * light[0] + e[1] * light[1] + e[2] * light[2]), h = Math.max(0, e[0] * half[0] + e[1] * half[1] + e[2] * half[2]);
      const b = (dark ? 0.2 : 0.34) + 0.6 * d, s = 70 * h ** 24;
      return (255 << 24) | (Math.min(255, 214 * b + s) << 16) | (Math.min(255, 196 * b + s) << 8) | Math.min(255, 172 * b + s);
    };
    const dot = (x, y, z, colour) => {
      const p = Math.floor(width / 2 + scale * (axes[0][0] * x + axes[0][1] * y + axes[0][2] * z));
      const q = Math.floor(height / 2 - scale * (axes[1][0] * x + axes[1][1] * y + axes[1][2] * z));
      if (p < 0 || q < 0 || p + 1 >= width || q + 1 >= height) return;
      const far = axes[2][0] * x + axes[2][1] * y + axes[2][2] * z;
      for (let a = 0; a < 4; a++) {
        const at = (q + (a >> 1)) * width + p + (a & 1);
        if (far > depth[at]) { depth[at] = far; out[at] = colour; }
      }
    };
    const thin = Math.max(1, 2 ** Math.floor(Math.log2(Math.max(1, (1.2 * (nx - 1)) / (2 * rx * scale)))));
    const shaded = (side, i, j, way) => { const [gx, gy] = side.slopes(i, j, k); return shade(-way * gx, -way * gy, way); };
    for (let i = 0; i < nx; i += thin) {
      for (let j = 0; j < ny; j += thin) {
        if (lens.round && square(xs[i]) + square(ys[j]) > rx * rx) continue;
        dot(xs[i], ys[j], exit.height(i, j, k) - middle, shaded(exit, i, j, axes[2][2] > 0 ? 1 : -1));
        dot(xs[i], ys[j], entrance.height(i, j, k) - middle, shaded(entrance, i, j, lens.mirror ? 1 : -1));
      }
    }
    const wall = (x, y, gx, gy) => {
      const i = Math.round(((x / rx + 1) / 2) * (nx - 1)), j = Math.round(((y / ry + 1) / 2) * (ny - 1)), top = exit.height(i, j, k), base = entrance.height(i, j, k);
      const steps = Math.ceil(1.2 * scale * Math.abs(top - base)) + 1, colour = shade(gx, gy, 0);
      for (let s = 0; s < steps; s++) dot(x, y, base - middle + (s / steps) * (top - base), colour);
    };
    const around = Math.ceil(1.2 * scale * Math.PI * 2 * rx);
    if (lens.round) for (let s = 0; s < around; s++) { const w = (2 * Math.PI * s) / around; wall(rx * Math.cos(w), ry * Math.sin(w), Math.cos(w), Math.sin(w)); }
    else for (let s = 0; s <= around / 3; s++) {
      const w = (6 * s) / around - 1;
      for (const side of [-1, 1]) { wall(Math.max(-1, Math.min(1, w)) * rx, side * ry, 0, side); wall(side * rx, Math.max(-1, Math.min(1, w)) * ry, side, 0); }
    }
    const sheet = document.createElement("canvas");
    sheet.width = width; sheet.height = height;
    sheet.getContext("2d").putImageData(picture, 0, 0);
    const context = canvas.getContext("2d");
    context.imageSmoothingQuality = "high";
    context.drawImage(sheet, 0, 0, canvas.width, canvas.height);
  }

  let asked = false, moving = false, rest = 0;
  const redraw = () => { if (!asked) { asked = true; requestAnimationFrame(() => { asked = false; draw(); }); } };
  const move = () => { moving = true; redraw(); clearTimeout(rest); rest = setTimeout(() => { moving = false; redraw(); }, 150); };
  const turn = (a, b) => { view.yaw += a; view.pitch += b; move(); };
  const enlarge = (by) => { view.zoom = Math.max(0.5, Math.min(3, view.zoom * by)); move(); };
  let last = null;
  canvas.addEventListener("pointerdown", (e) => { last = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", (e) => {
    if (!last) return;
    turn(0.008 * (e.clientX - last[0]), 0.008 * (e.clientY - last[1]));
    last = [e.clientX, e.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
  canvas.addEventListener("keydown", (e) => {
    const act = { ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
      "+": () => enlarge(1.15), "=": () => enlarge(1.15), "-": () => enlarge(1 / 1.15) }[e.key];
    if (act) { act(); e.preventDefault(); }
  });
  const slider = byId("relief"), say = () => { byId("relief-out").textContent = view.relief < 1.01 ? "true to scale" : `${view.relief.toFixed(1)} times as deep, about the best sphere`; };
  slider.value = (100 * Math.log(usual)) / Math.log(DEEPEST);
  const set = () => { view.relief = DEEPEST ** (slider.value / 100); say(); move(); };
  slider.addEventListener("input", set);
  new ResizeObserver(redraw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  set();
}

// ---- controls

/** What the screen's place, the light's lean and the source's size are where the lens was designed, and how far each may go. */
function ranges() {
  const { screen, lights } = held, first = lights[0], { still } = held, sign = screen.z < 0 ? -1 : 1;
  const far = Math.abs(screen.z - held.lens.zIn), across = Math.max(...screen.resolution.map((m, k) => m * screen.pixel[k]));
  const own = 2 * Math.max(...first.extent), at = first.near ? Math.abs(first.places[0][2]) : 1;
  const size = first.near ? own : (2 * Math.asin(own / 2) * 180) / Math.PI;
  const wide = ((0.15 * across) / far) * (first.near ? at : 180 / Math.PI); // blurs 15 % of the screen
  return {
    sign,
    throw: screen.focal ? null : { value: sign * screen.z, min: Math.max(0.3 * sign * screen.z, first.rays ? sign * first.rays[0].z + 1 : 0), max: 2 * sign * screen.z, unit: "mm" },
    leanx: still ? null : { value: 0, min: -15, max: 15, unit: "°" },
    leany: still ? null : { value: 0, min: -15, max: 15, unit: "°" },
    size: still ? null : { value: size, min: 0, max: Math.max(2 * size, wide), unit: first.near ? "mm" : "°" },
  };
}

const tidy = (v, digits = 5) => Number(v.toPrecision(digits));

async function start() {
  if (!window.DecompressionStream) throw new Error("This browser is too old to unpack the page's data.");
  const { cloud, target, waves, wavesColour } = await unpacked(), range = ranges(), asked = new URLSearchParams(location.hash.slice(1));
  const names = ["throw", "leanx", "leany", "size"].filter((name) => range[name]), touched = new Set();
  const areas = areasOf(cloud.shape), dense = (light) => (areas ? Float64Array.from(light, (v, k) => v / areas[k]) : light); // irradiance
  for (const name of ["throw", "leanx", "leany", "size"]) byId(`${name}-control`).hidden = !range[name];
  solidView(byId("solid"), cloud);
  byId("scale").textContent = `${held.screen.resolution.map((m, k) => tidy(m * held.screen.pixel[k], 4)).join(" × ")} ${held.screen.unit}, ${held.screen.resolution.join(" × ")} pixels.`;
  byId("size-name").textContent = held.lights[0].near ? "Size of the source" : "Angular size of the source";
  byId("size-unit").textContent = range.size ? range.size.unit : "";
  const aim = target && dense(target), brightest = (light) => (target ? (most(aim) / sum(target)) * sum(light) : most(dense(light)));
  if (target) paintLight(byId("target"), aim, most(aim));
  for (const id of target ? [] : ["target-figure", "difference-figure", "rms-row"]) byId(id).hidden = true;
  if (waves) paintLight(byId("waves"), dense(waves), brightest(waves), wavesColour && wavesColour.map(dense));
  if (waves && target) byId("waves-rms").textContent = compared(waves, target).rms.toFixed(3);
  for (const id of ["waves-figure", "waves-row"]) byId(id).hidden = !waves || (id === "waves-row" && !target);

  let graphics = null;
  const wanted = asked.get("engine");
  if (wanted !== "cpu" && !held.lights[0].rays) {
    try { graphics = graphicsTracer(cloud, wanted === "gpu"); } catch (error) { graphics = null; }
  }
  byId("gpu-choice").hidden = !graphics;
  byId("gpu").checked = Boolean(graphics);

  for (const name of names) {
    const { value, min, max } = range[name], fine = tidy((max - min) / 1000, 1);
    for (const id of [name, `${name}-number`]) {
      Object.assign(byId(id), { min: tidy(min), max: tidy(max), step: id === name ? fine : "any" });
      byId(id).value = byId(id).defaultValue = tidy(value);
      byId(id).addEventListener("input", () => {
        const other = id === name ? `${name}-number` : name;
        if (byId(id).value === "" || !Number.isFinite(byId(id).valueAsNumber)) return;
        byId(other).value = byId(id).value;
        touched.add(name);
        trace();
      });
    }
    if (asked.has(name)) { byId(name).value = byId(`${name}-number`).value = asked.get(name); touched.add(name); }
  }
  byId("controls").addEventListener("reset", () => { touched.clear(); setTimeout(() => { byId("gpu").checked = Boolean(graphics); sides(); trace(); }); });
  byId("controls").addEventListener("submit", (e) => e.preventDefault());
  // From its +z, as image files are: behind a lens' screen, and before a mirror's, unless it is turned over.
  const views = ["seen from behind it", `seen from the ${held.lens.mirror ? "mirror’s" : "lens’"} side`];
  if (!held.screen.facing) views.reverse();
  const sides = () => {
    const other = byId("mirrored").checked;
    document.querySelector(".panels").classList.toggle("mirrored", other);
    byId("side").textContent = views[Number(other)];
  };
  byId("other-side").textContent = views[1];
  sides();
  byId("mirrored").addEventListener("change", sides);
  byId("gpu").addEventListener("change", () => trace());

  /** What the controls say; what was not touched is exactly as designed. */
  const setting = () => {
    const read = (name) => (!range[name] ? 0 : touched.has(name) ? Number(byId(`${name}-number`).value) : range[name].value);
    return { z: range.throw ? range.sign * read("throw") : held.screen.z, leanX: read("leanx"), leanY: read("leany"), size: touched.has("size") ? read("size") : null };
  };

  let turn = 0;
  /** Run a generator to its end in slices; null if the controls moved meanwhile. */
  async function finished(steps, mine) {
    for (let from = performance.now(); ; ) {
      const { done, value } = steps.next();
      if (done) return value;
      if (performance.now() - from > SLICE) {
        await new Promise((go) => setTimeout(go));
        if (mine !== turn) return null;
        from = performance.now();
      }
    }
  }
  const traced = (beams, z, thin) => (graphics && byId("gpu").checked ? graphics.traced(beams, z, thin) : tracedHere(cloud, beams, z, thin));

  /** The image of all beams, and its planes of red, green and blue, null if all light has the colour of the source. */
  function* seen(beams, z, thin) {
    const colours = [...new Set(beams.map((beam) => beam.colour))];
    if (colours.every((colour) => !colour)) return { image: yield* traced(beams, z, thin), planes: null };
    const [image, ...planes] = Array.from({ length: 4 }, () => new Float64Array(held.screen.resolution[0] * held.screen.resolution[1]));
    for (const colour of colours) {
      const part = yield* traced(beams.filter((beam) => beam.colour === colour), z, thin);
      part.forEach((v, k) => {
        image[k] += v;
        for (let c = 0; c < 3; c++) planes[c][k] += colour[c] * v;
      });
    }
    return { image, planes };
  }

  function show({ image, planes }, beams, thin, began) {
    paintLight(byId("caustic"), dense(image), brightest(image), planes && planes.map(dense));
    byId("light").textContent = `${(100 * sum(image)).toFixed(1)} %`;
    if (target) {
      const { error, rms } = compared(image, target);
      paintDifference(byId("difference"), error);
      byId("rms").textContent = rms.toFixed(3);
    }
    const cells = (beams.length * (cloud.nx - 1) * (cloud.ny - 1)) / square(thin), on = graphics && byId("gpu").checked;
    byId("how").textContent = `${tidy(cells / 1e6, 2)} million cells, ${Math.round(performance.now() - began)} ms, ${on ? "graphics processor" : "processor"}`;
  }

  async function trace() {
    const mine = ++turn, now = setting(), began = performance.now();
    try {
      const quick = beamsOf(now, 24), coarse = Math.min(32, 4 * 2 ** Math.ceil(Math.log2(Math.sqrt(quick.length))));
      const first = await finished(seen(quick, now.z, coarse), mine);
      if (!first) return null;
      show(first, quick, coarse, began);
      await new Promise((go) => setTimeout(go));
      if (mine !== turn) return null;
      const beams = beamsOf(now), thin = thinning(beams.length), found = await finished(seen(beams, now.z, thin), mine);
      if (!found) return null;
      show(found, beams, thin, began);
      return found.image;
    } catch (error) {
      if (!graphics || mine !== turn) throw error;
      graphics = null; // lost to another program, or out of memory: the processor goes on
      byId("gpu").checked = false;
      byId("gpu-choice").hidden = true;
      return trace();
    }
  }
  const image = await trace();
  if (asked.has("numbers") && image) {
    // For whoever checks the page: what it traced, float32 [i, j], in base64.
    const bytes = new Uint8Array(Float32Array.from(image).buffer), text = document.createElement("pre");
    text.id = "numbers"; text.hidden = true;
    text.dataset.engine = graphics && byId("gpu").checked ? `gpu ${graphics.name}` : "cpu";
    text.textContent = btoa(bytes.reduce((s, b) => s + String.fromCharCode(b), ""));
    document.body.append(text);
  }
}

start().catch((error) => {
  byId("failure").textContent = `The lens cannot be traced here: ${error.message}`;
  byId("failure").hidden = false;
});
