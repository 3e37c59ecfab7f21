"use strict";
// Traces the lens that the page holds, shows it, and answers the controls.  Lengths are mm, angles degrees where a person reads them.
//
// The image is the sum of beams: light of one point of the source at one refractive index.  A beam is cut by the grid of the exit's
// points into cells.  The rays through a cell's four corners are traced exactly (Snell's law at the flat entrance and at the exit,
// Fresnel's losses, absorption); the power that enters through the cell is spread evenly over a rectangle on the screen about the mean
// of the four landing points, as wide as a parallelogram of the same edges has standard deviations, and shared out among the pixels
// that it covers.  No light is lost by that, and where cells are smaller than pixels the image is that of endless rays.
//
//   x, y, z, zx, zy   a point of the exit, its height and slopes         t   thickness of the glass below it
//   ax, ay, az        direction of the ray in air before the lens        n   refractive index, 1 before a mirror
//   dx, dy, dz        direction before the exit, a / n along the entrance
//   ex, ey            where it passes the entrance; w, power per area there that arrives on the screen
//   px, py            landing point, in pixels from the screen's low edges
//
// The graphics processor does the same in a vertex shader, one point a cell; its text below follows the functions here.

const FRESNEL = { none: 0, schlick: 1, exact: 2 };
const SMALLEST = 1e-3; // of a rectangle's sides, pixels: folded light has none
const MARGIN = 8; // pixels beyond the screen that the graphics processor draws on, since points are dropped by their middle
const SLICE = 14; // ms of work between two answers to the person
const BLUR = 3; // beams for each square pixel of the blur, and at most, of one place of an extended source
const MOST_BEAMS = 300;
const DEEPEST = 100; // times that the relief is shown as deep
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

async function unpacked() {
  const [nx, ny] = held.cloud.z.shape, parts = {};
  for (const [name, part] of Object.entries(held.cloud)) parts[name] = part && (await decoded(part));
  const target = held.target && (await decoded(held.target)), waves = held.waves && (await decoded(held.waves));
  const wavesColour = held.wavesColour && (await Promise.all(held.wavesColour.map(decoded)));
  return { cloud: { nx, ny, ...parts }, target, waves, wavesColour };
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
    const extent = extentOf(light, setting.size), places = light.places.length;
    const far = Math.abs(setting.z - held.lens.zIn) / (light.near ? 1 : light.axis[2]);
    const blur = Math.max(...extent.map((e, k) => ((2 * e) / pixel[k]) * (light.near ? far / Math.abs(light.places[0][2]) : far)));
    let count = blur < 0.2 ? 1 : Math.min(Math.max(8, Math.ceil(BLUR * blur * blur)), Math.ceil(most / Math.sqrt(places)));
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

/** By how much the grid is thinned out: many beams make a smooth image, of which coarser cells are enough. */
const thinning = (beams) => (beams <= 4 ? 1 : beams <= 48 ? 2 : 4);

// ---- tracing on the processor

/** Rows of corners: landing points, places on the entrance, power per area; px is NaN where no light leaves. */
const cornerRow = (length) => ["px", "py", "ex", "ey", "w"].reduce((row, name) => ({ ...row, [name]: new Float64Array(length) }), {});

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

/** Trace the corners of row i of the grid, every `thin`-th point, into `row`. */
function traceRow(cloud, beam, z, i, thin, row) {
  const { lens, screen } = held, { ny } = cloud, { n, near, x0, y0, h } = beam, [rx, ry] = lens.size.map((s) => s / 2);
  const [[ux, uy, uz], [vx, vy, vz], [nx, nyy, nz]] = screen.axes, [mx, my] = centreAt(z);
  const x = (2 * i / (cloud.nx - 1) - 1) * rx, { fresnel } = lens;
  const flat = beam.near ? 1 : reflectance(fresnel, Math.sqrt(1 - square(beam.ax) - square(beam.ay)),
    Math.sqrt(1 - square(beam.ax / n) - square(beam.ay / n)), 1 / n);
  for (let j = 0, b = 0; j < ny; j += thin, b++) {
    const k = i * ny + j, y = (2 * j / (ny - 1) - 1) * ry, zx = cloud.zx[k], zy = cloud.zy[k], height = cloud.z[k], t = height - lens.zIn;
    let dx, dy, dz, ex, ey, w, lost = flat;
    if (near) {
      const qx = x - x0, qy = y - y0, r = Math.sqrt(qx * qx + qy * qy) || 1e-30;
      let rho = (r * h) / (h + t / n), l = 0, sine = 0, c = 1; // rho: from below the source to the entrance point, by Newton's method
      for (let step = 0; step < 4; step++) {
        l = Math.sqrt(rho * rho + h * h); sine = rho / l; c = Math.sqrt(n * n - sine * sine);
        rho -= (rho + (t * sine) / c - r) / (1 + (t * n * n * h * h) / (c * c * c * l * l * l));
      }
      l = Math.sqrt(rho * rho + h * h); sine = rho / l; c = Math.sqrt(n * n - sine * sine);
      const ax = (sine * qx) / r, ay = (sine * qy) / r, az = h / l;
      dx = ax / n; dy = ay / n; dz = c / n;
      ex = x - (t * sine * qx) / (c * r); ey = y - (t * sine * qy) / (c * r); // from the exit: differences of near numbers
      w = (intensity(beam, ax, ay, az) * az * az * az) / (h * h);
      lost = fresnel ? reflectance(fresnel, az, dz, 1 / n) : 0;
    } else {
      dx = beam.ax / n; dy = beam.ay / n; dz = Math.sqrt(1 - dx * dx - dy * dy);
      ex = x - (t * dx) / dz; ey = y - (t * dy) / dz;
      w = 1;
    }
    w *= beam.power;
    if (cloud.profile) w *= cloud.profile[k];
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
        w *= (1 - lost) * (1 - reflectance(fresnel, c / length, s / length, n));
      }
      if (lens.absorption) w *= Math.exp((-lens.absorption * t) / dz);
    }
    const way = ((z - height) * nz - (x - mx) * nx - (y - my) * nyy) / (ox * nx + oy * nyy + oz * nz);
    const qx = x - mx + way * ox, qy = y - my + way * oy, qz = height + way * oz - z;
    row.px[b] = way > 0 ? (qx * ux + qy * uy + qz * uz - screen.low[0]) / screen.pixel[0] : NaN;
    row.py[b] = (qx * vx + qy * vy + qz * vz - screen.low[1]) / screen.pixel[1];
    row.ex[b] = ex; row.ey[b] = ey; row.w[b] = w;
  }
}

/** Part of a cell with its middle at x, y on the exit and sides along x and y from e to f on the entrance that both apertures pass. */
function passed(x, y, e0, f0, e1, f1) {
  const [rx, ry] = held.lens.size.map((s) => s / 2);
  if (!held.lens.round) return within(e0, f0, rx) * within(e1, f1, ry);
  const side = Math.sqrt(Math.abs((f0 - e0) * (f1 - e1))), edge = (r) => Math.min(1, Math.max(0, 0.5 + (rx - r) / side));
  return Math.min(edge(Math.sqrt(x * x + y * y)), edge(0.5 * Math.sqrt(square(e0 + f0) + square(e1 + f1))));
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
    const w = 0.25 * (p.w[b] + p.w[c] + q.w[b] + q.w[c]) * passed(x, (b + 0.5) * dy - ry, 0.5 * (p.ex[b] + p.ex[c]),
      0.5 * (q.ex[b] + q.ex[c]), 0.5 * (p.ey[b] + q.ey[b]), 0.5 * (p.ey[c] + q.ey[c]));
    if (!(w > 0)) continue;
    const area = 0.5 * Math.abs((q.ex[c] - p.ex[b]) * (q.ey[b] - p.ey[c]) - (q.ex[b] - p.ex[c]) * (q.ey[c] - p.ey[b]));
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
  let before = cornerRow(count), now = cornerRow(count);
  for (const beam of beams) {
    for (let i = 0; i < cloud.nx; i += thin) {
      traceRow(cloud, beam, z, i, thin, now);
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
uniform sampler2D cloud, table; uniform ivec2 points; uniform int thin;
uniform bool near, isRound, isMirror, cut; uniform int fresnel;
uniform vec3 origin, axis, u, v, normal; uniform vec2 direction, radius, middle, low, pixel; uniform vec4 frame;
uniform float n, power, zIn, absorption, chord, z, largest, smallest;
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
bool corner(ivec2 at, out vec2 landing, out vec2 entrance, out float w) {
  vec4 p = texelFetch(cloud, at.yx, 0);
  vec2 xy = (2.0 * vec2(at) / vec2(points - 1) - 1.0) * radius;
  float t = p.x - zIn, lost = 0.0; vec3 d;
  if (near) {
    float h = origin.z; vec2 q = xy - origin.xy; float r = max(length(q), 1e-30), rho = r * h / (h + t / n), l, sine, c;
    for (int step = 0; step < 4; step++) {
      l = sqrt(rho * rho + h * h); sine = rho / l; c = sqrt(n * n - sine * sine);
      float steep = h / l;
      rho -= (rho + t * sine / c - r) / (1.0 + t * n * n * steep * steep / (c * c * c * l));
    }
    l = sqrt(rho * rho + h * h); sine = rho / l; c = sqrt(n * n - sine * sine);
    vec3 a = vec3(sine * q / r, h / l);
    d = vec3(a.xy / n, c / n); entrance = xy - t * sine / c * q / r;
    w = intensity(a) * a.z * (a.z / h) * (a.z / h);
    if (fresnel > 0) lost = reflectance(a.z, d.z, 1.0 / n);
  } else {
    d.xy = direction / n; d.z = sqrt(1.0 - dot(d.xy, d.xy)); entrance = xy - t * d.xy / d.z; w = 1.0;
    if (fresnel > 0) lost = reflectance(sqrt(1.0 - dot(direction, direction)), d.z, 1.0 / n);
  }
  w *= power * p.w;
  float norm2 = 1.0 + dot(p.yz, p.yz), c = d.z - dot(d.xy, p.yz); vec3 o;
  if (isMirror) { float twice = 2.0 * c / norm2; o = vec3(d.xy + twice * p.yz, d.z - twice); }
  else {
    float radicand = norm2 + n * n * (c * c - norm2);
    if (!(radicand > 0.0)) return false;
    float s = sqrt(radicand), gamma = (1.0 - n) * (1.0 + n) / (s + n * c);
    o = vec3(n * d.xy - gamma * p.yz, n * d.z + gamma);
    if (fresnel > 0) { float l = fresnel == 1 ? sqrt(norm2) : 1.0; w *= (1.0 - lost) * (1.0 - reflectance(c / l, s / l, n)); }
    if (absorption > 0.0) w *= exp(-absorption * t / d.z);
  }
  vec3 from = vec3(xy - middle, p.x - z);
  float way = -dot(from, normal) / dot(o, normal); vec3 q = from + way * o;
  landing = (vec2(dot(q, u), dot(q, v)) - low) / pixel;
  return way > 0.0;
}
float passed(vec2 exit, vec2 e, vec2 f) {
  vec2 part = clamp((min(max(e, f), radius) - max(min(e, f), -radius)) / abs(f - e), 0.0, 1.0);
  if (!isRound) return part.x * part.y;
  float side = sqrt(abs((f.x - e.x) * (f.y - e.y)));
  return clamp(0.5 + (radius.x - max(length(exit), 0.5 * length(e + f))) / side, 0.0, 1.0);
}
void main() {
  int along = (points.y - 1) / thin; ivec2 at = ivec2(gl_VertexID / along, gl_VertexID % along) * thin;
  vec2 a, b, c, d, ea, eb, ec, ed; float wa, wb, wc, wd;
  bool lit = corner(at, a, ea, wa); lit = corner(at + ivec2(0, thin), b, eb, wb) && lit;
  lit = corner(at + ivec2(thin, 0), c, ec, wc) && lit; lit = corner(at + thin, d, ed, wd) && lit;
  vec2 centre = 0.25 * (a + b + c + d), across = c + d - a - b, upward = b + d - a - c;
  vec2 sides = clamp(0.5 * sqrt(across * across + upward * upward), vec2(smallest), vec2(largest));
  vec2 g = ed - ea, f = ec - eb; float area = 0.5 * abs(g.x * f.y - f.x * g.y);
  vec2 exit = ((2.0 * vec2(at) + float(thin)) / vec2(points - 1) - 1.0) * radius;
  float share = passed(exit, 0.5 * vec2(ea.x + eb.x, ea.y + ec.y), 0.5 * vec2(ec.x + ed.x, eb.y + ed.y));
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
  const texels = new Float32Array(4 * cloud.z.length);
  for (let k = 0; k < cloud.z.length; k++) texels.set([cloud.z[k], cloud.zx[k], cloud.zy[k], cloud.profile ? cloud.profile[k] : 1], 4 * k);
  texture(0, gl.RGBA32F, cloud.ny, cloud.nx, gl.RGBA, texels);
  const tables = held.lights.map((light) => light.near && texture(1, gl.R32F, light.intensity.length, 1, gl.RED, new Float32Array(light.intensity)));
  const sum = texture(2, gl.RGBA32F, wide, tall, gl.RGBA, null);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sum, 0);
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) return null;
  gl.activeTexture(gl.TEXTURE2);
  gl.bindTexture(gl.TEXTURE_2D, null);
  const { lens, screen } = held, [rx, ry] = lens.size.map((s) => s / 2);
  gl.viewport(0, 0, wide, tall);
  gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE); gl.disable(gl.DEPTH_TEST);
  gl.uniform1i(at("cloud"), 0); gl.uniform1i(at("table"), 1);
  gl.uniform2i(at("points"), cloud.nx, cloud.ny);
  gl.uniform1i(at("isRound"), lens.round); gl.uniform1i(at("isMirror"), lens.mirror); gl.uniform1i(at("fresnel"), lens.fresnel);
  gl.uniform2f(at("radius"), rx, ry); gl.uniform2f(at("low"), ...screen.low); gl.uniform2f(at("pixel"), ...screen.pixel);
  gl.uniform3f(at("u"), ...screen.axes[0]); gl.uniform3f(at("v"), ...screen.axes[1]); gl.uniform3f(at("normal"), ...screen.axes[2]);
  gl.uniform4f(at("frame"), wide, tall, MARGIN, 0);
  gl.uniform1f(at("zIn"), lens.zIn); gl.uniform1f(at("absorption"), lens.absorption);
  gl.uniform1f(at("smallest"), SMALLEST); gl.uniform1f(at("largest"), gl.getParameter(gl.ALIASED_POINT_SIZE_RANGE)[1] - 2);
  const told = gl.getExtension("WEBGL_debug_renderer_info"), name = told ? String(gl.getParameter(told.UNMASKED_RENDERER_WEBGL)) : "";
  const where = Object.fromEntries(["near", "origin", "axis", "cut", "chord", "direction", "n", "power", "z", "middle", "thin"].map((key) => [key, at(key)]));

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
  // The least-squares fit of z by 1, x, y and x^2 + y^2 less its mean, which are orthogonal on this grid.
  const q0 = sum(xs.map(square)) / nx + sum(ys.map(square)) / ny, dots = [0, 0, 0, 0], norms = [0, 0, 0, 0];
  let high = -Infinity;
  for (let i = 0, k = 0; i < nx; i++) {
    for (let j = 0; j < ny; j++, k++) {
      [1, xs[i], ys[j], square(xs[i]) + square(ys[j]) - q0].forEach((b, m) => { dots[m] += b * cloud.z[k]; norms[m] += b * b; });
      high = Math.max(high, cloud.z[k]);
    }
  }
  const [c0, cx, cy, cq] = dots.map((d, m) => d / norms[m]);
  const fit = (x, y) => c0 + cx * x + cy * y + cq * (x * x + y * y - q0);
  let rough = 0;
  for (let i = 0, k = 0; i < nx; i++) {
    for (let j = 0; j < ny; j++, k++) rough += square(cloud.zx[k] - cx - 2 * cq * xs[i]) + square(cloud.zy[k] - cy - 2 * cq * ys[j]);
  }
  const usual = Math.min(DEEPEST, Math.max(1, 0.25 / Math.sqrt(rough / count || 1)));
  const base = lens.mirror ? high + 0.2 * Math.max(...lens.size) : lens.zIn, size = Math.hypot(2 * rx, 2 * ry);

  function draw() {
    if (!canvas.clientWidth) return;
    const ratio = Math.min(2, window.devicePixelRatio || 1), finer = moving ? 1 : 2; // than the canvas, for smooth edges
    canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.width * 0.75);
    const width = finer * canvas.width, height = finer * canvas.height;
    const picture = new ImageData(width, height), out = new Uint32Array(picture.data.buffer);
    const depth = new Float32Array(width * height).fill(-Infinity), k = view.relief, dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const ca = Math.cos(view.yaw), sa = Math.sin(view.yaw), cb = Math.cos(view.pitch), sb = Math.sin(view.pitch);
    const axes = [[ca, -sa, 0], [sa * cb, ca * cb, -sb], [sa * sb, ca * sb, cb]]; // right, up and towards the eye
    const scale = (0.86 * height * view.zoom) / size, middle = 0.5 * (c0 + base);
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
    const flat = shade(0, 0, lens.mirror ? 1 : -1), surface = (i, j, at) => fit(xs[i], ys[j]) + k * (cloud.z[at] - fit(xs[i], ys[j])) - middle;
    for (let i = 0; i < nx; i += thin) {
      for (let j = 0; j < ny; j += thin) {
        if (lens.round && square(xs[i]) + square(ys[j]) > rx * rx) continue;
        const at = i * ny + j, fx = cx + 2 * cq * xs[i], fy = cy + 2 * cq * ys[j], way = axes[2][2] > 0 ? 1 : -1;
        dot(xs[i], ys[j], surface(i, j, at), shade(-way * (fx + k * (cloud.zx[at] - fx)), -way * (fy + k * (cloud.zy[at] - fy)), way));
        dot(xs[i], ys[j], base - middle, flat);
      }
    }
    const wall = (x, y, gx, gy) => {
      const i = Math.round(((x / rx + 1) / 2) * (nx - 1)), j = Math.round(((y / ry + 1) / 2) * (ny - 1)), top = surface(i, j, i * ny + j);
      const steps = Math.ceil(1.2 * scale * Math.abs(top - base + middle)) + 1, colour = shade(gx, gy, 0);
      for (let s = 0; s < steps; s++) dot(x, y, base - middle + (s / steps) * (top - base + middle), colour);
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
  const { screen, lights } = held, first = lights[0], sign = screen.z < 0 ? -1 : 1;
  const far = Math.abs(screen.z - held.lens.zIn), across = Math.max(...screen.resolution.map((m, k) => m * screen.pixel[k]));
  const own = 2 * Math.max(...first.extent), at = first.near ? Math.abs(first.places[0][2]) : 1;
  const size = first.near ? own : (2 * Math.asin(own / 2) * 180) / Math.PI;
  const wide = ((0.15 * across) / far) * (first.near ? at : 180 / Math.PI); // blurs 15 % of the screen
  return {
    sign,
    throw: { value: sign * screen.z, min: 0.3 * sign * screen.z, max: 2 * sign * screen.z, unit: "mm" },
    leanx: { value: 0, min: -15, max: 15, unit: "°" },
    leany: { value: 0, min: -15, max: 15, unit: "°" },
    size: { value: size, min: 0, max: Math.max(2 * size, wide), unit: first.near ? "mm" : "°" },
  };
}

const tidy = (v, digits = 5) => Number(v.toPrecision(digits));

async function start() {
  if (!window.DecompressionStream) throw new Error("This browser is too old to unpack the page's data.");
  const { cloud, target, waves, wavesColour } = await unpacked(), range = ranges(), asked = new URLSearchParams(location.hash.slice(1));
  const names = ["throw", "leanx", "leany", "size"], touched = new Set();
  solidView(byId("solid"), cloud);
  byId("scale").textContent = `${held.screen.resolution.map((m, k) => tidy(m * held.screen.pixel[k], 4)).join(" × ")} mm, ${held.screen.resolution.join(" × ")} pixels.`;
  byId("size-name").textContent = held.lights[0].near ? "Size of the source" : "Angular size of the source";
  byId("size-unit").textContent = range.size.unit;
  if (target) paintLight(byId("target"), target, most(target));
  for (const id of target ? [] : ["target-figure", "difference-figure", "rms-row"]) byId(id).hidden = true;
  if (waves) paintLight(byId("waves"), waves, target ? (most(target) / sum(target)) * sum(waves) : most(waves), wavesColour);
  if (waves && target) byId("waves-rms").textContent = compared(waves, target).rms.toFixed(3);
  for (const id of ["waves-figure", "waves-row"]) byId(id).hidden = !waves || (id === "waves-row" && !target);

  let graphics = null;
  const wanted = asked.get("engine");
  if (wanted !== "cpu") {
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
    const read = (name) => (touched.has(name) ? Number(byId(`${name}-number`).value) : range[name].value);
    return { z: range.sign * read("throw"), leanX: read("leanx"), leanY: read("leany"), size: touched.has("size") ? read("size") : null };
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
    const total = sum(image), white = target ? (most(target) / sum(target)) * total : most(image);
    paintLight(byId("caustic"), image, white, planes);
    byId("light").textContent = `${(100 * total).toFixed(1)} %`;
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
