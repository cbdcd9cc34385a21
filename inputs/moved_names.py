"""Public names that moved to a sub-package; the old place still has them, with a warning, until version 1.0."""

from __future__ import annotations

MOVED: dict[str, dict[str, tuple[str, ...]]] = {
    "phasemark.data": {
        "phasemark.data.bank": ("BankGroup",),
        "phasemark.data.export": ("export_frames",),
        "phasemark.data.files": (
            "mesh_sha256",
            "versions",
            "write_atomically",
            "write_checksum",
        ),
        "phasemark.data.frames": (
            "FrameSubset",
            "is_frame_set",
        ),
        "phasemark.data.measured": (
            "SimulatedRecording",
            "simulate_recording",
            "write_measured",
            "write_recording",
        ),
        "phasemark.data.pages": (
            "summary_sentences",
            "write_characterisation",
        ),
        "phasemark.data.partial_outputs": (
            "build_part",
            "estimate_build",
            "merge_parts",
            "parse_part",
        ),
        "phasemark.data.plans": (
            "Distribution",
            "MeshPlan",
            "format_grid",
            "parse_grid",
            "planned_size",
            "read_bank_plan",
        ),
        "phasemark.data.verify": (
            "verify_bank",
            "verify_frames",
        ),
        "phasemark.inputs": (
            "read_checksum",
            "unverified",
            "verify_checksum",
        ),
    },
    "phasemark.landmarks": {
        "phasemark.landmarks.figures": ("mesh_html",),
        "phasemark.landmarks.mesh": (
            "DEFAULT_TOLERANCE_M",
            "LOWER",
            "MAX_FACES",
            "UPPER",
        ),
        "phasemark.landmarks.mesh_files": (
            "MeshReport",
            "MeshWarning",
        ),
        "phasemark.landmarks.spec": (
            "Box",
            "Cone",
            "Cylinder",
            "Revolution",
            "Sphere",
        ),
        "phasemark.landmarks.symmetry": (
            "MAX_SYMMETRY",
            "has_symmetry",
            "symmetry_tolerance_m",
        ),
    },
    "phasemark.matcher": {
        "phasemark.matcher.accuracy": (
            "Bound",
            "GridLoss",
            "SpacingLoss",
            "TrialSetup",
            "TrialSummary",
            "Trials",
            "confusion_probability",
            "grid_loss",
            "run_trials",
        ),
        "phasemark.matcher.calibration": (
            "Calibration",
            "KnownPoses",
            "Mounting",
            "PoseStd",
            "filter_poses",
            "frames_of_poses",
            "read_poses",
        ),
        "phasemark.matcher.diagnosis": (
            "Change",
            "Diagnosis",
        ),
        "phasemark.matcher.filters": (
            "PixelState",
            "kalman",
            "kalman_step",
            "noise_free",
        ),
        "phasemark.matcher.likelihood": (
            "Surroundings",
            "estimate_surroundings",
        ),
        "phasemark.matcher.match": ("Candidate",),
        "phasemark.matcher.position": (
            "LandmarkMap",
            "MappedLandmark",
            "PRIOR_STD",
            "Placement",
            "ViewEstimate",
            "read_landmark_map",
        ),
        "phasemark.matcher.recordings": (
            "MotionTest",
            "motion_test",
        ),
        "phasemark.matcher.statistics": (
            "ErrorStatistics",
            "Interval",
            "binomial_interval",
            "error_statistics",
            "mean_interval",
            "nees",
            "rms_interval",
            "within_ellipsoid",
        ),
        "phasemark.matcher.sweep": (
            "Cell",
            "Condition",
            "Difference",
            "Method",
            "SHIPPED_SWEEPS",
            "SweepPlan",
            "SweepTrials",
            "compare_cells",
            "read_sweep",
            "read_sweep_plan",
            "sweep_frames",
        ),
    },
    "phasemark.render": {
        "phasemark.render.bench": (
            "Characterisation",
            "Comparison",
            "FittedField",
            "SensorFit",
            "SheetQuantity",
            "fit_sensor",
        ),
        "phasemark.render.exposure": (
            "Ablation",
            "Motion",
            "ablate",
            "capture_moving",
            "render_moving",
        ),
        "phasemark.render.figures": (
            "PAPER_CMAP",
            "range_figure",
            "terminal_figure",
        ),
        "phasemark.render.phasor_images": (
            "wrap_difference_m",
            "wrap_range_m",
        ),
        "phasemark.render.planar": (
            "PlanarLandmark",
            "planar_images",
        ),
        "phasemark.render.sensor": (
            "CameraUnit",
            "Harmonic",
            "pulse_harmonics",
            "square_harmonics",
        ),
        "phasemark.render.view": (
            "delta_period_rad",
            "wrap_delta_difference_rad",
            "wrap_delta_rad",
        ),
    },
}
"""For each room, the names by where they are now."""
