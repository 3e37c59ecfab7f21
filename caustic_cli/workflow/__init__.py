"""Complete tasks for the command line and the library: design, render, export and studies."""
