"""The mounting of a camera from frames at known poses."""
