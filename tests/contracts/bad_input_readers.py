"""Bad inputs to readers of files that others wrote: curves, meshes, recordings."""
