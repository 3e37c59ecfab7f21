"""A network from picture to lens: trained on made pictures without any lens to copy, and compared with the transport start.

    python tests/benchmarks/picture_network.py --train FILE [--minutes 5] [--device cuda]
    python tests/benchmarks/picture_network.py --compare FILE [--pictures flame,house] [--iterations 0,20,60]    a table

The network maps a picture, N x N pixels of mean 1, to a lens for parallel light: a potential psi over the lens, whose light
at s (in lens widths) lands at s + grad psi (in picture widths).  In between stand a few steps from coarse to fine.  Each step
samples the picture, the caustic so far and its difference from the picture where the light of every place lands, a U-Net
answers with a correction of the Laplacian of psi, and the cosine transform solves for psi.  Cosines end at a border an
eighth of a width beside the lens, so that light at its edge may move either way.  The loss is the relative RMS error of the
splatted caustic, at the pixels and at several times their width, with penalties for light beside the picture and for folds.

Training takes all its time, of which most is that of the host, and writes FILE every SECONDS.  The comparison, on the CPU, designs
from optimal transport as a design does, from transport on fewer cells, from the network and from the offset surface, judges each
by rays that no design used, and gives processor seconds on one thread.
"""

from __future__ import annotations

import argparse
import copy
import functools
import math
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from quality import EXAMPLES
from quality import pictures as known
from torch import Tensor, nn
from torch.nn import functional

from caustic_cli.inverse.designer import Designer
from caustic_cli.inverse.initial_surface import first_surface, net_of
from caustic_cli.inverse.problem import Problem
from caustic_cli.inverse.surface_from_map import heights
from caustic_cli.io.files import atomic_path
from caustic_cli.studies.retrace import retrace
from caustic_cli.workflow.preparation import prepare
from caustic_cli.workflow.reporter import Listener

#: Pixels of the levels from coarse to fine, and steps on each.
LEVELS, STEPS = (32, 64, 128), 3
#: Channels of the U-Net at its resolutions, each half of the one before.
WIDTHS = (24, 48, 96, 128)
#: Border beside the lens and dark pixels beside the picture, in its widths; rays of the loss along a pixel.
BORDER, RAYS = 0.125, 3
#: Widths of pixels at which the loss compares, and the weight of each.
POOLS = {1: 1.0, 2: 0.5, 4: 0.5, 8: 0.5}
#: Weights of squared distances from the picture, in its widths, and of negative areas that light lands on.
BESIDE, FOLDED = 20.0, 0.3
#: Values an irradiance is not told from 0 by, and seconds between checkpoints and lines of progress.
DARK, SECONDS = 0.05, 20.0
#: Parts of the time at which training of each level begins, with half of the pictures of the level before; pictures made at a time.
BEGIN, POOL = (0.0, 0.12, 0.3), 16
#: Times that each start is computed, of whose seconds the median counts.
ROUNDS = 3
#: Shapes of a picture of dead leaves, and lines of one of strokes.
LEAVES, LINES = 40, 10


class Basis:
    """Cosines over the lens and its border, L cells along each axis for n pixels; `orders` of derivatives at places in widths."""

    def __init__(self, n: int, device: torch.device | str):
        self.n, self.pad = n, round(BORDER * n)
        self.cells = n + 2 * self.pad
        self.width = self.cells / n
        k = torch.arange(self.cells, dtype=torch.float64)
        self.waves = (math.pi * k / self.width).to(device)
        self.centres = (k + 0.5) / n - BORDER
        transform = self.at(self.centres, 0).T * 2.0 / self.cells
        transform[0] /= 2.0
        square = self.waves.square()[:, None] + self.waves.square()
        square[0, 0] = math.inf
        self.transform, self.inverse = (t.to(device, torch.float32) for t in (transform, -1.0 / square))
        self.places = {order: self.at(self.centres, order).to(device, torch.float32) for order in (0, 1, 2)}
        self.regular = self.rays((torch.arange(2 * n) + 0.5) / (2 * n))

    def at(self, places: Tensor, order: int) -> Tensor:
        """Derivatives of the cosines at places (k,), widths of the lens from its edge: (k, L) float64."""
        phase = (places.to(self.waves)[:, None] + BORDER) * self.waves
        return (torch.cos(phase), -self.waves * torch.sin(phase), -(self.waves**2) * torch.cos(phase))[order]

    def potential(self, laplacian: Tensor) -> Tensor:
        """Coefficients (b, L, L) of the psi of this Laplacian at the centres of cells (b, L, L)."""
        return self.transform @ laplacian @ self.transform.T * self.inverse

    def rays(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Places (k,) of rays along an axis, and the cosines and their derivatives there (k, L)."""
        return tuple(t.to(self.waves.device, torch.float32) for t in (places, self.at(places, 0), self.at(places, 1)))

    @staticmethod
    def landing(psi: Tensor, first: tuple, second: tuple) -> tuple[Tensor, Tensor]:
        """Where the light of `rays` first (k) x second (l) lands, in picture widths: two (b, k, l)."""
        (s, a, da), (t, b, db) = first, second
        return s[:, None] + da @ psi @ b.T, t + a @ psi @ db.T

    def splat(self, x: Tensor, y: Tensor) -> Tensor:
        """The caustic (b, L, L) of rays of equal power that land at x, y (b, k, l): bilinear, mean 1 over the picture."""
        count, last = x[0].numel(), self.cells - 1
        at = [((c.flatten(1) + BORDER) * self.n - 0.5).clamp(0.0, last - 1e-3) for c in (x, y)]
        low = [c.detach().floor() for c in at]
        (fx, fy), (i, j) = [c - w for c, w in zip(at, low, strict=True)], [w.long() for w in low]
        base = (torch.arange(len(x), device=x.device)[:, None] * self.cells + i) * self.cells + j
        image = x.new_zeros(len(x) * self.cells**2)
        for step, part in ((0, (1 - fx) * (1 - fy)), (1, (1 - fx) * fy), (self.cells, fx * (1 - fy)), (self.cells + 1, fx * fy)):
            image = image.index_add(0, (base + step).flatten(), part.flatten())
        return image.view(len(x), self.cells, self.cells) * (self.n**2 / count)

    def jittered(self, count: int = RAYS) -> tuple[Tensor, Tensor, Tensor]:
        """`count` rays a pixel, equidistant, at random."""
        return self.rays((torch.arange(count * self.n, device=self.waves.device) + torch.rand(1).item()) / (count * self.n))

    def caustic(self, psi: Tensor, first: tuple, second: tuple) -> tuple[Tensor, Tensor]:
        """The caustic (b, L, L) of a grid of `rays`, and the mean square distance of its light from the picture (b,)."""
        x, y = self.landing(psi, first, second)
        beside = sum(functional.relu((c - 0.5).abs() - 0.5) ** 2 for c in (x, y))
        return self.splat(x, y), beside.mean((1, 2))

    def framed(self, picture: Tensor) -> Tensor:
        """A picture (b, n, n) within dark pixels, filtered as a splat is: (b, L, L)."""
        dark = functional.pad(picture, [self.pad] * 4)[:, None]
        line = picture.new_tensor([[0.125, 0.75, 0.125]])
        return functional.conv2d(dark, (line.T * line)[None, None], padding=1)[:, 0]


class UNet(nn.Module):
    """(b, channels, L, L) -> (b, L, L), 0 before training."""

    def __init__(self, channels: int, widths: tuple[int, ...]):
        super().__init__()
        self.down = nn.ModuleList(_block(a, b) for a, b in zip((channels, *widths), widths, strict=False))
        self.up = nn.ModuleList(_block(a + b, b) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.last = nn.Conv2d(widths[0], 1, 1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Tensor) -> Tensor:
        kept = []
        for block in self.down:
            x = block(functional.avg_pool2d(x, 2) if kept else x)
            kept.append(x)
        for block, beside in zip(self.up, kept[-2::-1], strict=True):
            x = block(torch.cat((functional.interpolate(x, beside.shape[2:], mode="bilinear"), beside), 1))
        return self.last(x)[:, 0]


def _block(a: int, b: int) -> nn.Sequential:
    first, second = (nn.Conv2d(c, b, 3, padding=1) for c in (a, b))
    return nn.Sequential(first, nn.GroupNorm(math.gcd(b, 8), b), nn.SiLU(), second, nn.SiLU())


class PictureNetwork(nn.Module):
    """Pictures (b, N, N) of mean 1 -> coefficients of psi, by steps on several levels."""

    CHANNELS = 9

    def __init__(self, levels: tuple[int, ...] = LEVELS, steps: int = STEPS, widths: tuple[int, ...] = WIDTHS):
        super().__init__()
        self.shape = {"levels": levels, "steps": steps, "widths": widths}
        self.levels, self.steps = levels, steps
        self.nets = nn.ModuleList(UNet(self.CHANNELS, widths) for _ in levels)

    def forward(self, pictures: Tensor, levels: int | None = None):
        """Yields (basis, picture in dark pixels, [psi after each step]) of every level, or of the first ones."""
        psi = pictures.new_zeros(len(pictures), 1, 1)
        for n, net in zip(self.levels[:levels], self.nets, strict=False):
            basis = basis_of(n, str(pictures.device))
            goal, found = basis.framed(functional.avg_pool2d(pictures, pictures.shape[-1] // n)), []
            wider = basis.cells - psi.shape[-1]
            psi = functional.pad(psi.detach(), [0, wider, 0, wider])
            for _ in range(self.steps):
                seen = self.seen(basis, goal, psi).contiguous(memory_format=torch.channels_last)
                with torch.autocast(pictures.device.type, torch.bfloat16, enabled=pictures.device.type == "cuda"):
                    change = net(seen)
                psi = psi + basis.potential(change.float())
                found.append(psi)
            yield basis, goal, found

    @torch.no_grad()
    def seen(self, basis: Basis, goal: Tensor, psi: Tensor) -> Tensor:
        """What a step is told of every cell of the lens: (b, CHANNELS, L, L)."""
        zero, one, two = (basis.places[o] for o in (0, 1, 2))
        ux, uy, xx, yy, xy = (a @ psi @ b.T for a, b in ((one, zero), (zero, one), (two, zero), (zero, two), (one, one)))
        area = (1.0 + xx) * (1.0 + yy) - xy * xy
        image = basis.caustic(psi, basis.regular, basis.regular)[0]
        centres = basis.centres.to(psi)
        to = torch.stack((centres + uy, centres[:, None] + ux), -1)  # grid_sample counts the last axis first
        there = torch.stack((goal, image, torch.log((image + DARK) / (goal + DARK))), 1)
        wanted, got, ratio = functional.grid_sample(there, 2.0 * (to - 0.5) / basis.width, align_corners=False).unbind(1)
        inside = ((centres > 0) & (centres < 1)).to(psi)
        lens = (inside[:, None] * inside).expand_as(psi)
        light = torch.log(wanted + DARK), torch.log((wanted * area).clamp_min(0.0) + DARK), area.clamp(-2, 8)
        return torch.stack((wanted.clamp(max=8), *light, (got - wanted).clamp(-4, 4), ratio, 4 * ux, 4 * uy, lens), 1)


@functools.lru_cache(maxsize=16)
def basis_of(n: int, device: str) -> Basis:
    """The basis of a level."""
    return Basis(n, device)


def loss_of(network: PictureNetwork, pictures: Tensor, levels: int | None = None) -> tuple[Tensor, Tensor]:
    """The loss of all steps, and the relative RMS errors (levels,) after the last step of each level."""
    total, errors = pictures.new_zeros(()), []
    for basis, goal, found in network(pictures, levels):
        for k, psi in enumerate(found):
            image, beside = basis.caustic(psi, basis.jittered(), basis.jittered())
            off = image - goal
            pooled = {w: functional.avg_pool2d(off[:, None], w, ceil_mode=True).square().sum((1, 2, 3)) * w * w for w in POOLS}
            rms = {w: (value / basis.n**2 + 1e-8).sqrt() for w, value in pooled.items()}
            one, two, zero = (basis.places[o] for o in (1, 2, 0))
            xx, yy, xy = (a @ psi @ b.T for a, b in ((two, zero), (zero, two), (one, one)))
            folded = functional.relu(0.02 - (1.0 + xx) * (1.0 + yy) + xy * xy).mean((1, 2))
            loss = sum(weight * rms[w] for w, weight in POOLS.items()) + BESIDE * beside + FOLDED * folded.clamp(max=1.0)
            total = total + loss.mean() / 2.0 ** (len(found) - 1 - k)
        errors.append(rms[1].mean().detach())
    return total / len(errors), torch.stack(errors)


def made_pictures(count: int, n: int, device: torch.device | str) -> Tensor:
    """Pictures of mean 1 that no file holds: (count, n, n)."""
    each = -(-count // 5)
    x = (torch.arange(n, device=device) + 0.5) / n
    x, y = x[:, None], x[None, :]
    u = functools.partial(_uniform, each, device)
    rough, smooth = (_noise(each, n, u(*power)) for power in ((0.8, 1.8), (1.5, 3.0)))
    soft = u(0.01, 0.3)
    kinds = [torch.sigmoid(rough), torch.sigmoid((smooth - u(-0.8, 0.8)) / soft)]
    leaves, strokes, blobs = 0.3 * rough + u(0, 1), torch.zeros_like(rough), 0.1 * smooth + u(-1, 1) * x + u(-1, 1) * y
    for _ in range(LEAVES):
        turn, size, thin = u(0, math.pi), 0.4 * u(0, 1) ** 3 + 0.02, u(0.3, 1.0)
        p, q = x - u(-0.1, 1.1), y - u(-0.1, 1.1)
        p, q = (p * turn.cos() + q * turn.sin()) / size, (q * turn.cos() - p * turn.sin()) / (size * thin)
        far = torch.where(u(0, 1) < 0.5, torch.hypot(p, q), torch.maximum(p.abs(), q.abs()))
        cover = ((1.0 - far) * size * n).clamp(0, 1)
        leaves = torch.lerp(leaves, u(0, 1) + 0.1 * u(0, 1) * rough, cover)
    for _ in range(LINES):
        px, py, turn, long, wide = u(0, 1), u(0, 1), u(0, 2 * math.pi), u(0.05, 0.5), u(0.008, 0.05)
        dx, dy = long * turn.cos(), long * turn.sin()
        along = (((x - px) * dx + (y - py) * dy) / (long * long)).clamp(0, 1)
        off = torch.hypot(x - px - along * dx, y - py - along * dy)
        strokes = torch.maximum(strokes, ((wide - off) * n).clamp(0, 1))
        size = u(0.02, 0.3)
        blobs = blobs + u(-1, 2) * torch.exp(-((x - u(0, 1)) ** 2 + (y - u(0, 1)) ** 2) / size**2)
    kinds = torch.cat([*kinds, leaves, strokes, blobs])
    low, high = kinds.amin((1, 2), True), kinds.amax((1, 2), True)
    kinds = (kinds - low) / (high - low)
    u = functools.partial(_uniform, len(kinds), device)
    kinds = torch.where(u(0, 1) < 0.3, 1.0 - kinds, kinds) ** torch.exp(u(-0.7, 0.9))
    others, mask = kinds[torch.randperm(len(kinds), device=device)], torch.sigmoid(_noise(len(kinds), n, u(2, 3)) / u(0.02, 0.5))
    kinds = torch.where(u(0, 1) < 0.4, torch.lerp(kinds, others, mask), kinds)
    kinds = torch.where(u(0, 1) < 0.2, kinds * others, kinds)
    radius, square = u(0.3, 0.5), torch.maximum((x - 0.5).abs(), (y - 0.5).abs())
    frame = ((radius - torch.where(u(0, 1) < 0.5, torch.hypot(x - 0.5, y - 0.5), square)) * n / u(1, 20)).clamp(0, 1)
    kinds = torch.where(u(0, 1) < 0.3, kinds * frame, kinds)
    floor = torch.where(u(0, 1) < 0.4, u(0.0, 0.02), u(0.0, 0.5))
    kinds = (floor + (1.0 - floor) * kinds)[torch.randperm(len(kinds), device=device)[:count]]
    return kinds / kinds.mean((1, 2), True).clamp_min(1e-3)


def _uniform(count: int, device: torch.device | str, low: float, high: float) -> Tensor:
    return low + (high - low) * torch.rand(count, 1, 1, device=device)


def _noise(count: int, n: int, power: Tensor) -> Tensor:
    """Noise (count, n, n) of mean 0 and variance 1, its amplitude falling with this power (count, 1, 1) of the frequency."""
    k = torch.hypot(torch.fft.fftfreq(2 * n)[:, None], torch.fft.rfftfreq(2 * n)[None]).to(power) * 2 * n
    spectrum = torch.randn(count, *k.shape, 2, device=power.device)
    noise = torch.fft.irfft2(torch.view_as_complex(spectrum) * k.clamp_min(1.0) ** -power)[:, :n, :n]  # a part: not periodic
    return (noise - noise.mean((1, 2), True)) / noise.std((1, 2), keepdim=True)


def train(
    network: PictureNetwork, file: Path | None, seconds: float, batch: int, rate: float, device: str, iterations: int = 0
) -> list[float]:
    """Train for a time or, where they are given, so many iterations; the loss of each.  file: of the averaged weights."""
    network.to(device).to(memory_format=torch.channels_last)
    averaged, losses, pool, began = copy.deepcopy(network), [], torch.zeros(0), time.monotonic()
    optimiser, said = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-4), began
    while (done := len(losses) / iterations if iterations else (time.monotonic() - began) / seconds) < 1.0:
        optimiser.param_groups[0]["lr"] = rate * min(1.0, (len(losses) + 1) / 50) * 0.5 * (1.0 + math.cos(math.pi * done))
        levels = sum(done >= part for part in BEGIN[: len(network.levels)])
        size = batch << (len(network.levels) - levels)
        if len(pool) < size:
            pool = made_pictures(POOL * batch, network.levels[-1], device)
        pictures, pool = pool[:size], pool[size:]
        loss, errors = loss_of(network, pictures, levels)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        if math.isfinite(value := loss.item()):
            optimiser.step()
        losses.append(value)
        kept = min(0.998, len(losses) / (len(losses) + 10))
        with torch.no_grad():
            torch._foreach_lerp_([*averaged.parameters()], [*network.parameters()], 1.0 - kept)
        if time.monotonic() - said > SECONDS:
            said = time.monotonic()
            levels = ", ".join(f"{n}: {e:.3f}" for n, e in zip(network.levels, errors.tolist(), strict=False))
            print(f"{said - began:5.0f} s, {len(losses)} iterations, loss {np.mean(losses[-50:]):.4f}; {levels}", flush=True)
            if file is not None:
                save(averaged, file)
    network.load_state_dict(averaged.state_dict())
    if file is not None:
        save(network, file)
    return losses


def save(network: PictureNetwork, file: Path) -> None:
    """Write a checkpoint, as a whole or not at all."""
    with atomic_path(file) as part:
        torch.save({"shape": network.shape, "weights": {k: v.cpu() for k, v in network.state_dict().items()}}, part)


def load(file: Path) -> PictureNetwork:
    """The network of a checkpoint, on the CPU."""
    found = torch.load(file, map_location="cpu", weights_only=True)
    network = PictureNetwork(**found["shape"])
    network.load_state_dict(found["weights"])
    return network.eval()


def start_of(network: PictureNetwork, problem: Problem) -> Tensor:
    """Control heights (n, m) mm, on the net of the first stage, of the network's lens for the picture of a problem."""
    goal = problem.target.float()
    with torch.inference_mode():
        *_, (basis, _, found) = network(goal[None] / goal.mean())
    return heights_of(basis, found[-1][0], problem)


def heights_of(basis: Basis, psi: Tensor, problem: Problem) -> Tensor:
    """Control heights (n, m) mm of the lens of a potential, coefficients (L, L).

    Light at p on the lens, mm from its middle, lands at mag (p + wide grad psi), the gradient of the potential of a map.  To first
    order in the angles that gives the heights; what remains is integrated as for transport.
    """
    lens, screen = problem.scene.lens, problem.scene.screen
    wide, size = 2.0 * lens.half_size[0], 2.0 * screen.half_size[0]
    places, psi = torch.linspace(0.0, 1.0, 2 * basis.n + 1, dtype=torch.float64), psi.double()
    rays = places, basis.at(places, 0), basis.at(places, 1)
    x, y = (((c - 0.5) * size)[0].numpy() for c in basis.landing(psi[None], rays, rays))
    at, value = (places.numpy() - 0.5) * wide, (rays[1] @ psi @ rays[1].T).numpy()
    first, second = at[:, None], at[None, :]
    map_ = SimpleNamespace(potential=size / wide * (0.5 * (first**2 + second**2) + wide**2 * value), x=x, y=y)
    mean, everywhere = float(lens.offset.heights(at, at).mean()), np.ones(x.shape, bool)
    z = heights(map_, (x, y), first, second, (0.0, 0.0, 1.0), lens.effective_index, screen.z, mean, everywhere)
    return net_of(at, at, z, problem.field(0))


def compare(file: Path, pictures: dict[str, Path], iterations: list[int], rays: int, preconditioner: str) -> None:
    """Print a Markdown table: processor seconds of each start, errors of designs from it after these iterations, the light beside
    the screen or in black before and after them, and processor seconds of start and iterations."""
    torch.set_num_threads(1)
    n = LEVELS[-1]
    said = {"mag": 1.0, "margin": 0.0, "screen.resolution": [n, n], "lens.control": [2 * n + 3] * 2, "design.waves": "off"}
    print(f"the network: {file.stat().st_size / 1e6:.1f} MB\n")
    print(f"| picture | start | its seconds | {' | '.join(f'after {k}' for k in iterations)} | light astray | seconds in all |")
    print("| --- " * (len(iterations) + 5) + "|", flush=True)
    ways = {
        "transport": lambda p: p.transport(True, math.inf).heights,
        f"transport, {n} cells": lambda p: first_surface(p.scene, p.target.numpy(), p.field(0), n).heights,
        "network": lambda p: start_of(load(file), p),
        "offset": lambda p: None,
    }
    for name, picture in pictures.items():
        for way, start in ways.items():
            begins = {"start": "offset"} if way == "offset" else {"start": "transport", "preconditioner": preconditioner}
            given = said | {f"design.{key}": value for key, value in begins.items()}
            problem = prepare(picture, given, say=Listener()).problem
            took = []
            for _ in range(ROUNDS):
                began = time.process_time()
                first = start(problem)
                took.append(time.process_time() - began)
            errors, astray, seconds = refined(problem, first, iterations, rays)
            spent, light = statistics.median(took), f"{astray[0]:.2%} to {astray[-1]:.2%}"
            print(f"| {name} | {way} | {spent:.2f} | {' | '.join(errors)} | {light} | {spent + seconds:.1f} |", flush=True)


def refined(problem: Problem, first: Tensor | None, iterations: list[int], rays: int) -> tuple[list[str], list[float], float]:
    """Errors of a design after these iterations, with their noise; the parts of its light that land beside the screen or in black;
    and its processor seconds without the start."""
    designer = Designer(problem.varied([replace(s, tolerance=0.0) for s in problem.stages], problem.options))
    initial = designer.initial_heights(first)
    state, seconds = designer.initial_state(None if initial is None else initial.heights), 0.0
    errors, astray = [], []
    for count in iterations:
        if count:
            began = time.process_time()
            state = designer.run(state, iterations=count)
            seconds += time.process_time() - began
        _, said = retrace(problem.scene, designer.field(state.stage), state.heights, problem.target.numpy(), rays=rays, seed=1)
        errors.append(f"{said['relative_rms']:.4f} ± {said['noise']:.4f}")
        astray.append(1.0 - said["on_screen"] * (1.0 - (said["in_black"] or 0.0)) / (1.0 - said["lost"]["fresnel"]))
    return errors, astray, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--train", type=Path, metavar="FILE")
    task.add_argument("--compare", type=Path, metavar="FILE")
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--batch", type=int, default=48)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--levels", default=",".join(map(str, LEVELS)))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pictures", default="flame,ball,portrait,tophat,house")
    parser.add_argument("--iterations", default="0,20,60,150")
    parser.add_argument("--preconditioner", default="none", choices=("none", "laplacian"), help="of the designs from a surface")
    parser.add_argument("--rays", type=int, default=4_000_000, help="of those who judge")
    options = parser.parse_args()
    if options.train:
        torch.manual_seed(options.seed)
        network = PictureNetwork(tuple(int(n) for n in options.levels.split(",")))
        print(f"{sum(p.numel() for p in network.parameters()):,} weights", flush=True)
        losses = train(network, options.train, 60.0 * options.minutes, options.batch, options.rate, options.device)
        print(f"{len(losses)} iterations, loss {np.mean(losses[:20]):.4f} at first and {np.mean(losses[-50:]):.4f} at last")
        return
    with tempfile.TemporaryDirectory() as folder:
        files = known(Path(folder)) | {name: EXAMPLES / f"{name}.png" for name in ("tophat", "house")}
        chosen = {name: files[name] for name in options.pictures.split(",")}
        compare(options.compare, chosen, [int(n) for n in options.iterations.split(",")], options.rays, options.preconditioner)


if __name__ == "__main__":
    main()
