"""Scenes: several bodies, their materials, and a camera anywhere (PHYSICS section 13)."""
