"""Settings for every test: one torch thread, fixed seeds, and hypothesis without randomness or clocks."""

import os
import warnings
from functools import cache
from pathlib import Path

from caustic_cli.cli import THREADS

os.environ |= THREADS | os.environ  # as the command does, before a library reads them
os.environ["CAUSTIC_EFFORT"] = "test"  # designs are small, here and in subprocesses, unless a test asks for more

import pytest
import torch
from hypothesis import HealthCheck, settings

from caustic_cli.commands import parser
from caustic_cli.optics.kernels import ahead

with warnings.catch_warnings():  # torch loads this module on the first forward-mode derivative, and it warns of torch itself
    warnings.simplefilter("ignore", DeprecationWarning)
    import torch._decomp.decompositions_for_jvp

torch.set_num_threads(1)  # the tests' tensors are small, and results must not depend on the machine's cores
settings.register_profile(
    "caustic", derandomize=True, deadline=None, max_examples=40, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("caustic")


#: Tests that take long: whole commands, kills, hard cases, documents.  `pytest -m "not slow"` is the inner loop: less than a
#: minute, and by test_export.py and test_several.py, which designs by a command, something of every part of the package.
SLOW = (
    "benchmarks",
    "faults",
    "independent",
    "stability",
    "waves",
    "test_aperture.py",
    "test_array_beam.py",
    "test_batch.py",
    "test_cli.py",
    "test_convergence.py",
    "test_curved_base.py",
    "test_design.py",
    "test_distribution.py",
    "test_effects_cli.py",
    "test_extended.py",
    "test_extending.py",
    "test_finish_models.py",
    "test_free_elements.py",
    "test_guide.py",
    "test_intersection.py",
    "test_irradiance.py",
    "test_kernel_cache.py",
    "test_lamp_cli.py",
    "test_light.py",
    "test_manufacture.py",
    "test_photograph.py",
    "test_measured.py",
    "test_movie.py",
    "test_others.py",
    "test_page.py",
    "test_page_rays.py",
    "test_picture_network.py",
    "test_project.py",
    "test_ranks.py",
    "test_ray_tracer.py",
    "test_source_image.py",
    "test_sources_cli.py",
    "test_spreads.py",
    "test_wave_design.py",
    "test_effects.py",
    "test_lenslet_packing.py",
    "test_library.py",
    "test_machine.py",
    "test_noise.py",
    "test_roundtrip.py",
    "test_scale.py",
    "test_stages.py",
    "test_system.py",
    "test_tilted_elements.py",
    "test_tolerances.py",
    "test_turning.py",
    "test_two_setups.py",
    "test_verify.py",
)


def pytest_sessionstart(session):
    """With an empty cache, the kernels of most tests are compiled while these are collected: once for all processes of xdist."""
    if not hasattr(session.config, "workerinput"):
        ahead.compile_behind(ahead.PARTS)


#: Tests of five to forty seconds each, together four minutes on two cores, that run with --long: of what seldom changes or
#: is tested elsewhere in smaller pieces.
LONG = (
    "test_an_index_is_designed_with_all_surfaces",
    "test_free_elements.py::test_a_coloured_picture",
    "faults/test_kill.py",
    "test_a_design_killed_before_its_first_checkpoint_is_begun_anew[index]",
    *(f"test_four_iterations_are_two_and_two_bitwise[{name}" for name in ("tilted]", "extended source]")),
    "test_free_gradient.py::test_a_picture_in_colour_is_designed",
    "test_a_robust_index_is_judged_with_its_errors",
    "test_four_iterations_are_two_and_two_bitwise[near source and surface, folded]",
    "test_a_flat_mirror_excludes_nothing_that_a_lens_has_by_itself",
    "test_surfaces_of_two_lenses_are_shaped_together",
    "test_the_commands_of_a_chapter_run[5-accuracy]",
    "test_the_commands_of_a_chapter_run[6-thesis]",
    "test_the_commands_of_a_chapter_run[17-lamp]",
    "test_draws_and_finishes_are_the_bytes_of_one_process",
    "test_light_that_the_page_holds_lands_as_render_says[the sun",
    *(f"judged_in_scenes_of_all_kinds[{name}" for name in ("gradient", "lenslets", "separate", "several", "ray file", "far field")),
    "test_the_commands_of_a_chapter_run[13-other-elements]",
    "test_the_commands_of_a_chapter_run[16-window]",
    "test_the_python_of_a_chapter_runs[7-library]",
    "test_error_against_efficiency_and_errors_of_alignment",
    "test_every_format_again[phase]",
    "test_a_designed_lens_obeys_its_limits",
    "test_files_of_one_index_have_that_of_the_one_wavelength",
    "test_an_addition_touches_few_files",
    "test_no_correction_makes_a_part_worse",
    "test_parts_in_other_light_and_mirrors_are_judged_too",
    "test_photographs_at_two_throws_tell_the_scale_of_the_relief_from_the_throw",
    "test_photographs_in_two_lights_are_judged_together",
    "test_the_relief_of_parts_of_the_right_height_is_so_within_its_uncertainty",
    "test_a_corrected_part_is_better_by_the_stated_amount",
    "test_the_simulated_cut_is_that_of_the_arcs[simple-inch]",
    "test_corners_and_the_picture_itself_find_the_screen_too",
    "test_a_fit_that_ends_on_another_surface_is_said",
    "test_advised_size_of_a_picture_has_the_relief_that_it_allows",
    "test_steep_wall_is_as_thick_as_by_default_and_opened_again",
    "test_a_folded_caustic_is_inferred_within_what_is_said",
    "test_one_photograph_is_enough_for_a_smooth_form_error[0.001-0.05-1]",
    "test_one_photograph_is_enough_for_a_smooth_form_error[0.003-0.25-3]",
    "test_one_photograph_is_enough_for_a_smooth_form_error[0.003-0.05-2]",
    "test_draws_have_the_covariance_of_the_fit",
    "test_both_sides_have_form_errors_of_their_own",
    "test_steps_are_those_of_a_true_staircase[printer1]",
    "test_steps_are_those_of_a_true_staircase[printer2]",
    "test_ring_is_milled_in_one_program",
    "test_roughing_in_four_axes_leaves_its_allowance[radius0-how0]",
    "test_roughing_in_four_axes_leaves_its_allowance[radius1-how1]",
)


@pytest.hookimpl(tryfirst=True)  # before fixtures of a module, whose figures depend on it
def pytest_runtest_setup(item):
    """One thread, also after a command that was given more."""
    torch.set_num_threads(1)


def pytest_collection_modifyitems(config, items):
    for item in items:
        if not config.getoption("--long") and any(name in item.nodeid for name in LONG):
            item.add_marker(pytest.mark.skip(reason="takes long: --long"))
        if not {*SLOW}.isdisjoint(item.path.relative_to(Path(__file__).parent).parts):
            item.add_marker(pytest.mark.slow)


def pytest_addoption(parser):
    parser.addoption("--long", action="store_true", help="run the tests of ten to forty seconds, too")
    parser.addoption("--hard-cases", action="store_true", help="print what the tests of tests/stability measured, as Markdown")


@pytest.fixture(params=["fused", "torch"])
def kernels(request, monkeypatch) -> str:
    """Both ways of doing the same on a CPU: the fused kernels, and the plain-torch reference that other devices use."""
    monkeypatch.setenv("CAUSTIC_KERNELS", {"fused": "", "torch": "torch"}[request.param])
    return request.param


@pytest.fixture(autouse=True, scope="session")
def _quick_wave_images():
    """None that takes more samples than those of a lens of some 4 mm, unless it is asked for: of a default lens it takes up to half
    a minute, beside rays that take a tenth of a second."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("effects", "waves"):
            patch.setattr(f"caustic_cli.studies.{name}.UNASKED", 2e7)
        yield


@pytest.fixture(autouse=True, scope="session")
def _one_parser():
    """One for all commands of a process: to make it takes most of the time of a command that is refused."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parser, "parser", cache(parser.parser))
        yield


@pytest.fixture(autouse=True)
def _seeded():
    """Every test starts from the same generator state and leaves torch's defaults alone."""
    torch.manual_seed(0)
    yield
    assert torch.get_default_dtype() == torch.float32
