"""Hessians as blocks: bands of rods, slices of nets."""
