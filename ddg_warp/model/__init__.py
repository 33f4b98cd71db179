"""Model, its state and its parameters by name, on a device."""
