"""The data sheet of a camera: what flat fields show, beside what closed forms predict."""
