"""Wave optics: the field behind a lens from an exact ray trace, and its propagation to the screen by the Fresnel integral.

wavefront      optical path and density of rays on a reference plane behind the lens
ray_aiming     rays through the points of a uniform grid on that plane
interpolation  interpolation of the wavefront between the traced nodes
sampling       sampling of the field on the reference plane and on the screen
propagation    the Fresnel integral as a single Fourier transform, integrated over pixels, with its adjoint
unsupported    scenes without a wave image, and why
tilted         images on tilted screens
image          incoherent sum over wavelengths and source points
"""
