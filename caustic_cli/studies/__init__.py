"""Questions with tables and plots: figures of merit, gradient images, accuracy against time."""
