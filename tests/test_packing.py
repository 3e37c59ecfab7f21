"""Compression of large control nets: lossless, and refused where the data are invalid."""

from __future__ import annotations

import io
import zlib

import h5py
import numpy as np
import pytest
import torch

from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import State
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.project.checkpoint import Checkpoint, load, save, seal
from caustic_cli.project.packing import LARGE, STEP, pack, rounded, unpack

SHAPES = [(1024, 1025), (2, 700, 800)]


def net_of(shape, seed=0, size=5.0) -> np.ndarray:
    """A smooth surface with creases, mm, in whole steps."""
    x, y = np.meshgrid(*(np.linspace(-size, size, n) for n in shape[-2:]), indexing="ij")
    plane = np.maximum(0.01 * x**2 + 0.02 * y, 0.003 * np.abs(x - y)) + 7.0
    out = np.broadcast_to(plane, shape) + 1e-8 * np.random.default_rng(seed).normal(size=shape)
    return rounded(torch.from_numpy(out)).numpy()


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_net_comes_back_to_the_last_bit_from_few_bytes(shape):
    net = net_of(shape)
    packed = pack(net)
    assert packed is not None and len(packed) < net.nbytes / 3
    back = unpack(packed, shape)
    assert back.dtype == net.dtype and (back == net).all() and (np.signbit(back) == np.signbit(net)).all()


def test_beside_one_that_is_alike_it_takes_fewer():
    net, like = net_of(SHAPES[0]), net_of(SHAPES[0], seed=1)
    like = net + np.where(np.arange(SHAPES[0][1]) % 64 == 0, like - net, 0.0)
    packed, alone = pack(net, like), pack(net)
    assert packed is not None and alone is not None and len(packed) < 0.5 * len(alone)
    assert (unpack(packed, net.shape, like) == net).all()


def test_a_rounded_net_is_off_by_half_a_step():
    net = torch.rand(1025, 1025, dtype=torch.float64)
    assert 0.3 * STEP < (rounded(net) - net).abs().max() <= 0.5 * STEP
    small = net[:100, :100]
    assert rounded(small) is small


def planes(net: np.ndarray) -> bytes:
    """Packed by the format of version 2, written out from its description: byte planes of differences in two's complement."""
    steps = (net / STEP).astype("<i8")
    across = np.concatenate([steps[:, :1], steps[:, 1:] - steps[:, :-1]], 1)
    both = np.concatenate([across[:1], across[1:] - across[:-1]])
    return zlib.compress(both.reshape(-1, 1).view(np.uint8).T.tobytes(), 1)


def test_signs_in_the_lowest_bit_take_less_than_half_of_a_complement():
    net = net_of(SHAPES[0])
    packed = pack(net)
    assert packed is not None and len(packed) < 0.6 * len(planes(net))
    extreme = np.zeros(SHAPES[0])
    extreme[::3, ::2], extreme[1::3, 1::2] = (2.0**50 - 1.0) * STEP, (1.0 - 2.0**50) * STEP
    assert (unpack(pack(extreme), extreme.shape) == extreme).all()


def test_a_checkpoint_of_version_2_is_read(saved):
    path, made = saved
    image = io.BytesIO(path.read_bytes()[512:])
    nets = {"lens/heights": made.state.heights, "start": made.state.start - made.state.heights}
    with h5py.File(image, "r+") as f:
        f.attrs["format_version"] = 2
        del f["unrounded"]
        for name, net in nets.items():
            del f[name]
            f[name] = np.frombuffer(planes(net.numpy()), np.uint8)
            f[name].attrs["shape"] = net.shape
    path.write_bytes(seal(image.getvalue()) + image.getvalue())
    back = load(path).state
    assert torch.equal(back.heights, made.state.heights) and torch.equal(back.start, made.state.start)


@pytest.mark.parametrize("kind", ["small", "no whole steps", "large values", "not finite", "beside one of no whole steps"])
def test_what_cannot_come_back_is_not_packed(kind):
    net, like = net_of(SHAPES[0]), None
    match kind:
        case "small":
            net = net[:100]
        case "no whole steps":
            net[3, 4] += 0.25 * STEP
        case "large values":
            net[3, 4] = 2.0**51 * STEP
        case "not finite":
            net[3, 4] = np.nan
        case _:
            like = net + 0.25 * STEP
    assert (net.size < LARGE) == (kind == "small")
    with np.errstate(invalid="ignore"):
        assert pack(net, like) is None


@pytest.mark.parametrize(
    "data",
    [b"", b"no zlib", zlib.compress(bytes(79)), zlib.compress(bytes(81)), zlib.compress(bytes(80))[:-6]],
    ids=["empty", "not packed", "short", "long", "cut"],
)
def test_bytes_that_are_no_net_are_refused(data):
    with pytest.raises(ValueError, match="net"):
        unpack(data, (2, 5))


@pytest.fixture
def saved(tmp_path):
    net, start = (torch.from_numpy(net_of(SHAPES[0], seed)) for seed in (0, 1))
    spaces = tuple(SplineSpace.uniform(n, 3) for n in net.shape)
    made = Checkpoint(State(net, start=start, unrounded=start + STEP), spaces, {}, {})
    save(tmp_path / "c.h5", made)
    return tmp_path / "c.h5", made


def test_a_checkpoint_of_a_large_net_is_small_and_exact(saved):
    path, made = saved
    back = load(path).state
    assert path.stat().st_size < 1.2 * made.state.heights.nbytes
    for name in ("heights", "start", "unrounded"):
        assert torch.equal(getattr(back, name), getattr(made.state, name))


@pytest.mark.parametrize("shape", [(1024, 1026), (1 << 20, 1 << 20), (0, 5), (-1024, -1025), (1024,)], ids=str)
def test_a_packed_net_of_a_wrong_shape_is_refused(saved, shape):
    path, _ = saved
    image = io.BytesIO(path.read_bytes()[512:])
    with h5py.File(image, "r+") as f:
        f["lens/heights"].attrs["shape"] = shape
    path.write_bytes(seal(image.getvalue()) + image.getvalue())
    with pytest.raises(InputError, match="damaged"):
        load(path)
