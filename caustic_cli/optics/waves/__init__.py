"""Light as a wave: the field behind a lens from an exact trace of rays, and its propagation to the screen.

wavefront   optical path and density of rays by their feet on a plane behind the lens
nodes       functions between the nodes at which rays are traced
seeking     the rays whose feet stand on an even grid
sampling    how finely field and screen are sampled
propagation Fresnel's integral as one Fourier transform, on pixels, with its adjoint
image       wavelengths and points of the source added up
"""

from __future__ import annotations

from caustic_cli.optics.waves.image import WaveImage, image_of, lines_of, lines_of_system, wave_image
from caustic_cli.optics.waves.sampling import NoWaveImage

__all__ = ["NoWaveImage", "WaveImage", "image_of", "lines_of", "lines_of_system", "wave_image"]
