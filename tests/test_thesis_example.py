"""The configurations of examples/thesis are all there and are what the tool reads; --quick is smaller."""

import sys
from pathlib import Path

import pytest

from caustic_cli.config import settings

THESIS = Path(__file__).resolve().parent.parent / "examples" / "thesis"


@pytest.fixture
def run(monkeypatch):
    monkeypatch.syspath_prepend(str(THESIS))
    import run  # noqa: PLC0415

    yield run
    for name in ("run", "page"):
        sys.modules.pop(name, None)


def test_every_experiment_has_a_configuration_that_reads(run, tmp_path):
    names = ["flat.toml", "point.toml", *(f"tophat-{p}.toml" for p in run.PAIRS), *(f"mag{m}.toml" for m in run.MAGS)]
    assert sorted(names) == sorted(p.name for p in THESIS.glob("*.toml")) and len(run.PAIRS) == 5
    for name in names:
        whole = settings.read(run.scaled(name, tmp_path, quick=False))["design"]["stages"]
        quick = settings.read(run.scaled(name, tmp_path, quick=True))["design"]["stages"]
        assert sum(s["rays"] for s in quick) * 5 == sum(s["rays"] for s in whole)
    assert [s["iterations"] for s in settings.read(run.scaled("point.toml", tmp_path, quick=True))["design"]["stages"]] == [10, 10]


def test_pairs_are_what_their_names_say(run):
    for pair in run.PAIRS:
        design = settings.read(THESIS / f"tophat-{pair}.toml")["design"]
        network, _, initial = pair.partition("-")
        assert design["network"] == network and design["initial"] == (initial or "zero")
