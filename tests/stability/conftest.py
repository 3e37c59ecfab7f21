"""Every hard case is measured against what a naive formula gives; `pytest tests/stability --hard-cases` prints the table."""

import math

import pytest
import torch

ROWS: list[tuple[str, str, float, float, float]] = []
DTYPES = (torch.float32, torch.float64)


@pytest.fixture(params=DTYPES, ids=["float32", "float64"])
def dtype(request) -> torch.dtype:
    return request.param


@pytest.fixture
def compare():
    """compare(family, what, naive, ours, bound): ours keeps the bound, the naive form breaks it ten times over."""

    def record(family: str, what: str, naive: float, ours: float, bound: float) -> None:
        assert math.isfinite(ours) and ours <= bound, f"{family}: {what}: {ours:.3g} is more than {bound:.3g}"
        assert not naive <= 10.0 * bound, f"{family}: {what}: the naive form is as good ({naive:.3g})"
        ROWS.append((family, what, float(naive), float(ours), float(bound)))

    return record


def figure(value: float) -> str:
    return "NaN" if math.isnan(value) else "infinite" if math.isinf(value) else "0" if value == 0 else f"{value:.1e}"


def pytest_terminal_summary(terminalreporter, config):
    if not config.getoption("--hard-cases"):
        return
    worst: dict[tuple[str, str], list[float]] = {}
    for family, what, naive, ours, bound in ROWS:  # of all precisions and both ways of computing
        row = worst.setdefault((family, what), [naive, ours, bound])
        row[1], row[2] = max(row[1], ours), max(row[2], bound)
        row[0] = row[0] if not naive > row[0] and not math.isnan(naive) else naive
    terminalreporter.write_line("\n| family | error of | naive | ours | bound |\n| --- | --- | --- | --- | --- |")
    for (family, what), row in worst.items():
        terminalreporter.write_line(f"| {family} | {what} | {' | '.join(map(figure, row))} |")
