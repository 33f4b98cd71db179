"""Of rods on their own, which lie in chains."""
