"""Tells whether renderings are the same up to noise: the tool `scripts/imagediff`, and the stored references of the image
tests."""
