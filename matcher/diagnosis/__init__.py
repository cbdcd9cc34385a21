"""Why a frame is refused, and which change of a setting would make it fit."""
