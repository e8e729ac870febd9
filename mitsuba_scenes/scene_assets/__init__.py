"""Generators of the meshes, normal maps and environments of the project's own scenes (numpy only)."""
