"""Hessians as blocks: bands of rods, slices of the coupled system."""
