"""The outputs of a render: each is one object, in a file of its own, and stands in the list below in the order in which they are
written and shown."""

from __future__ import annotations

from typing import Any

from caustic_cli.workflow.outputs.base import Output
from caustic_cli.workflow.outputs.cut import MachinedSurface
from caustic_cli.workflow.outputs.day import DayOfSunlight
from caustic_cli.workflow.outputs.explanation import Explanation
from caustic_cli.workflow.outputs.finish import FinishedPart
from caustic_cli.workflow.outputs.hours import Hours
from caustic_cli.workflow.outputs.illumination import Illumination
from caustic_cli.workflow.outputs.image import RayPicture
from caustic_cli.workflow.outputs.page import InteractivePage
from caustic_cli.workflow.outputs.photograph import PartPhotograph
from caustic_cli.workflow.outputs.rays_plot import RaysPlot
from caustic_cli.workflow.outputs.report import ManufacturingReport
from caustic_cli.workflow.outputs.second_target import SecondPicture
from caustic_cli.workflow.outputs.shop import ShopPage
from caustic_cli.workflow.outputs.stray import Stray
from caustic_cli.workflow.outputs.test_card import TestCard
from caustic_cli.workflow.outputs.tolerances import ToleranceAnalysis
from caustic_cli.workflow.outputs.values import PixelValues
from caustic_cli.workflow.outputs.verification import MitsubaComparison
from caustic_cli.workflow.outputs.waves import WavePicture

OUTPUTS: tuple[type[Output], ...] = (
    RayPicture,
    SecondPicture,
    Hours,
    Stray,
    WavePicture,
    PixelValues,
    MachinedSurface,
    FinishedPart,
    InteractivePage,
    Explanation,
    ManufacturingReport,
    ShopPage,
    ToleranceAnalysis,
    Illumination,
    DayOfSunlight,
    RaysPlot,
    TestCard,
    PartPhotograph,
    MitsubaComparison,
)


def outputs_for(options: Any) -> tuple[Output, ...]:
    """The outputs that the options of `caustic render` ask for."""
    return tuple(output for kind in OUTPUTS if (output := kind.of(options)) is not None)
