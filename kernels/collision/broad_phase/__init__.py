"""Candidates of collision: AABBs, BVH queries, candidate validity, rod culling."""
