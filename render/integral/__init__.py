"""The exact area integral of PHYSICS section 3: edges, pieces of pixels, rays and their sum."""
