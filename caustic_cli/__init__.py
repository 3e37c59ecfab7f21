"""caustic: free-form lenses that throw a picture as a caustic."""

__version__ = "0.1.0"
