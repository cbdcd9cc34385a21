import math

import numpy as np
import pytest
from scipy import stats

from phasemark import UsageError
from phasemark.matcher import FilteredFrames, PixelKalman, kalman_filter, phasor_mean
from phasemark.matcher.filters import PixelState, kalman, kalman_step
from phasemark.matcher.filters.pooled_noise import moderated
from phasemark.render import (
    Flag,
    Frames,
    PhasorImages,
    Views,
    capture,
    measured_range_std,
    predicted_range_std,
    preset,
)

FALSE_ALARM = 1e-3  # of a whole test, whatever the number of cells

SENSOR = preset("pmd-16x16")
PERIOD_M = SENSOR.unambiguous_range_m


def sensor_of(rows, cols, **fields):
    return SENSOR.with_(rows=rows, cols=cols, **fields)


def wrapped(difference_m):
    return (difference_m + PERIOD_M / 2) % PERIOD_M - PERIOD_M / 2


def series(ranges, **extra):
    """Frames of one pixel from its ranges in time."""
    ranges = np.asarray(ranges, float).reshape(1, -1, 1, 1)
    extra = {name: np.broadcast_to(np.reshape(value, (1, -1, 1, 1)), ranges.shape) for name, value in extra.items()}
    return Frames(ranges, sensor=sensor_of(1, 1), **extra)


def electrons_for(std_m, sensor):
    """Amplitude and intensity whose noise law is std_m."""
    intensity_e = 10_000.0
    amplitude_e = sensor.metres_per_radian * math.sqrt(intensity_e) / (math.sqrt(2) * std_m)
    return amplitude_e, intensity_e


def captured(range_m, amplitude, n_frames, *, seed=0, rows=16, cols=16, **fields):
    """Frames of a grid of equal pixels."""
    sensor = sensor_of(rows, cols, **fields)
    phasor = np.full((1, rows, cols), amplitude * np.exp(1j * range_m / sensor.metres_per_radian))
    image = PhasorImages(phasor, np.abs(phasor), np.ones(phasor.shape), sensor, Views.broadcast(1.0))
    return capture(image, sensor, rng=np.random.default_rng(seed), n_frames=n_frames)


def assert_honest(error_m, std_m, margin=0.0, inflation=1.0):
    """Compare the mean square of errors over their standard deviations with χ², and a margin."""
    low, high = stats.chi2.ppf([FALSE_ALARM / 4, 1 - FALSE_ALARM / 4], error_m.size)
    assert (1 - margin) * low < ((error_m / std_m) ** 2).sum() / inflation < (1 + margin) * high


def one_at_a_time(frames, process_var_m2=0.0):
    recursive = PixelKalman(frames.sensor, process_var_m2)
    for k in range(frames.n_frames):
        frame = [
            None if a is None else a[:, k : k + 1] for a in (frames.range_m, frames.amplitude_e, frames.intensity_e)
        ]
        recursive.update(Frames(*frame, sensor=frames.sensor, flags=frames.flags[:, k : k + 1]))
    return recursive.result()


# --- the general filter -------------------------------------------------------------------------------------------


def test_general_filter_equals_weighted_least_squares_for_a_moving_target():
    rng = np.random.default_rng(1)
    dt, n = 0.1, 20
    A = np.array([[1, dt], [0, 1]])
    B = np.array([[dt**2 / 2], [dt]])
    u = rng.normal(size=(n, 1))
    z = rng.normal(size=(n, 1))
    x0, P0, r = np.array([0.3, -0.2]), np.diag([2.0, 3.0]), 0.25
    x, P = kalman(x0, P0, z, A=A, B=B, u=u, H=[[1.0, 0.0]], Q=np.zeros((2, 2)), R=[[r]])
    # Without process noise every measurement is linear in the first state: z_k = (Aᵏ)[0] x0 + known control.
    rows, offsets, power, drift = [], [], np.eye(2), np.zeros(2)
    for k in range(n):
        power, drift = A @ power, A @ drift + B[:, 0] * u[k, 0]
        rows.append(power[0])
        offsets.append(drift[0])
    information = np.linalg.inv(P0) + np.transpose(rows) @ rows / r
    start = np.linalg.solve(information, np.linalg.solve(P0, x0) + np.transpose(rows) @ (z[:, 0] - offsets) / r)
    np.testing.assert_allclose(x[-1], power @ start + drift, rtol=1e-9)  # two routes of 20 small products
    np.testing.assert_allclose(P[-1], power @ np.linalg.inv(information) @ power.T, rtol=1e-9)


def test_general_filter_uses_the_papers_five_equations():
    x, P, z = np.array([1.0, 2.0]), np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([1.5, 0.0, -1.0])
    A, H = np.array([[0.9, 0.2], [0.0, 1.1]]), np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 2.0]])
    Q, R = np.diag([0.1, 0.2]), np.diag([0.3, 0.4, 0.5])
    x_prior, P_prior = A @ x, A @ P @ A.T + Q
    gain = P_prior @ H.T @ np.linalg.inv(H @ P_prior @ H.T + R)
    x_new, P_new = kalman_step(x, P, z, A=A, H=H, Q=Q, R=R)
    np.testing.assert_allclose(x_new, x_prior + gain @ (z - H @ x_prior), rtol=1e-12)  # rounding
    np.testing.assert_allclose(P_new, (np.eye(2) - gain @ H) @ P_prior, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"A": np.eye(3)}, r"'A' must have shape \(2, 2\), got \(3, 3\)"),
        ({"H": [1.0, 0.0]}, r"'H' must have shape \(1, 2\), got \(2,\)"),
        ({"B": np.eye(2)}, "'B' and 'u' go together"),
        ({"x": 1.0}, "'x' and 'z' must be vectors"),
        ({"R": [[0.0]], "P": np.zeros((2, 2))}, "singular"),
    ],
)
def test_general_filter_names_what_does_not_fit(changes, message):
    good = {"x": [0.0, 0.0], "P": np.eye(2), "z": [1.0], "A": np.eye(2), "H": [[1.0, 0.0]], "Q": np.zeros((2, 2))}
    arguments = {**good, "R": [[1.0]], **changes}
    with pytest.raises(UsageError, match=message):
        kalman_step(arguments.pop("x"), arguments.pop("P"), arguments.pop("z"), **arguments)


# --- the per-pixel Kalman filter ----------------------------------------------------------------------------------


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time])
def test_without_process_noise_the_filter_is_the_running_mean(run):
    frames = captured(4.0, 0.5, 50)
    filtered = run(frames)
    np.testing.assert_allclose(filtered.range_m, frames.range_m.mean(axis=1), rtol=1e-12)  # rounding of 50 sums
    amplitude_e, intensity_e = frames.amplitude_e.mean(axis=1), frames.intensity_e.mean(axis=1)
    law = SENSOR.metres_per_radian * np.sqrt(intensity_e) / (math.sqrt(2) * amplitude_e)
    np.testing.assert_allclose(filtered.std_m, law / math.sqrt(50), rtol=1e-12)
    np.testing.assert_allclose(filtered.amplitude_e, amplitude_e, rtol=1e-12)
    np.testing.assert_allclose(filtered.n_effective, 50, rtol=1e-12)
    assert (filtered.state == PixelState.RETURN).all()
    assert not filtered.std_from_scatter


def test_the_variance_of_the_filter_is_that_of_its_error():
    frames = captured(4.0, 0.5, 50, rows=64, cols=64, seed=3)
    filtered = kalman_filter(frames)
    assert_honest(filtered.range_m - 4.0, filtered.std_m)
    expected = predicted_range_std(0.5, 0.5, SENSOR) / math.sqrt(50)
    # the mean amplitude of 50 frames is known to 0.6 %, and carries 0.1 % of noise bias
    np.testing.assert_allclose(filtered.std_m, expected, rtol=0.03)


@pytest.mark.parametrize("process_var_m2", [1e-5, 1e-3])
def test_with_process_noise_the_pixel_filter_equals_the_general_one(process_var_m2):
    std_m = 0.02
    amplitude_e, intensity_e = electrons_for(std_m, SENSOR)
    z = 3 + np.random.default_rng(4).normal(0, 0.02, 30)
    frames = series(z, amplitude_e=amplitude_e, intensity_e=intensity_e)
    filtered = kalman_filter(frames, process_var_m2)
    one = [[1.0]]
    x, P = kalman(z[:1], [[std_m**2]], z[1:, None], A=one, H=one, Q=[[process_var_m2]], R=[[std_m**2]])
    assert filtered.range_m.item() == pytest.approx(x[-1].item(), rel=1e-12)
    assert filtered.std_m.item() == pytest.approx(math.sqrt(P[-1].item()), rel=1e-12)


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time])
def test_with_process_noise_gain_and_variance_reach_their_steady_state(run):
    std_m, process_var_m2 = 0.02, 1e-5
    amplitude_e, intensity_e = electrons_for(std_m, SENSOR)
    q = process_var_m2 / std_m**2
    steady = (-q + math.sqrt(q * q + 4 * q)) / 2  # P/R and the gain: the positive root of p² + qp − q = 0
    z = np.full(200, 3.0)
    settled = run(series(z, amplitude_e=amplitude_e, intensity_e=intensity_e), process_var_m2)
    assert settled.std_m.item() == pytest.approx(math.sqrt(steady) * std_m, rel=1e-9)
    assert settled.n_effective.item() == pytest.approx(1 / steady, rel=1e-9)
    z[-1] += 0.1
    stepped = run(series(z, amplitude_e=amplitude_e, intensity_e=intensity_e), process_var_m2)
    assert stepped.range_m.item() - 3.0 == pytest.approx(0.1 * steady, rel=1e-9)


def test_with_process_noise_the_variance_is_honest_about_a_wandering_range():
    rng = np.random.default_rng(5)
    sensor = sensor_of(64, 64)
    std_m, process_var_m2, n = 0.02, 4e-5, 60
    truth = 4 + np.cumsum(rng.normal(0, math.sqrt(process_var_m2), (1, n, 64, 64)), axis=1)
    z = truth + rng.normal(0, std_m, truth.shape)
    amplitude_e, intensity_e = (np.full(z.shape, value) for value in electrons_for(std_m, sensor))
    filtered = kalman_filter(Frames(z, amplitude_e, intensity_e, sensor=sensor), process_var_m2)
    assert_honest(filtered.range_m - truth[:, -1], filtered.std_m)


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time, phasor_mean])
def test_ranges_on_both_sides_of_the_wrap_average_to_the_wrap(run):
    frames = series([0.05, PERIOD_M - 0.05, 0.05, PERIOD_M - 0.05])
    assert wrapped(run(frames).range_m.item()) == pytest.approx(0.0, abs=1e-12)
    frames = series([PERIOD_M - 0.1, 0.04])
    assert run(frames).range_m.item() == pytest.approx(PERIOD_M - 0.03, abs=1e-9)


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time, phasor_mean])
def test_noise_across_the_wrap_leaves_no_bias_and_stays_in_range(run):
    frames = captured(0.0, 0.5, 50, seed=7, rows=32, cols=32)
    filtered = run(frames)
    assert ((filtered.range_m >= 0) & (filtered.range_m < PERIOD_M)).all()
    assert_honest(wrapped(filtered.range_m), filtered.std_m)


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time, phasor_mean])
def test_invalid_frames_are_skipped(run):
    z = np.array([np.nan, 2.00, np.nan, 2.04, 2.05, np.nan, np.nan])
    amplitude_e = np.array([9.0, 5000, np.nan, 5000, 5000, 1e9, 1e9])
    with_gaps = run(series(z, amplitude_e=amplitude_e, intensity_e=np.full(7, 2e4)))
    without = run(series(z[[1, 3, 4]], amplitude_e=np.full(3, 5e3), intensity_e=np.full(3, 2e4)))
    assert with_gaps.range_m.item() == pytest.approx(without.range_m.item(), rel=1e-12)
    assert with_gaps.std_m.item() == pytest.approx(without.std_m.item(), rel=1e-12)
    assert with_gaps.n_effective.item() == pytest.approx(3, rel=1e-12)


@pytest.mark.parametrize("process_var_m2", [0.0, 1e-4])
def test_every_pixel_is_filtered_as_if_it_were_alone_to_the_last_bit(process_var_m2):
    rng, shape = np.random.default_rng(8), (3, 9, 4, 5)
    amplitude = rng.uniform(50, 500, shape)
    amplitude[rng.random(shape) < 0.1] = np.nan
    flags = rng.choice([0, int(Flag.NO_RETURN), int(Flag.MISSING)], shape, p=[0.6, 0.3, 0.1]).astype(np.uint8)
    flags[np.isnan(amplitude) & (flags == 0)] = int(Flag.NO_RETURN)
    frames = Frames(
        rng.uniform(0, PERIOD_M, shape), amplitude, rng.uniform(1e3, 1e4, shape), sensor=sensor_of(4, 5), flags=flags
    )
    found = kalman_filter(frames, process_var_m2)
    for i, row, col in np.ndindex(3, 4, 5):
        x = p = total = count = other = n_other = bright = 0.0
        z, a, b, f = (v[i, :, row, col] for v in (frames.range_m, frames.amplitude_e, frames.intensity_e, frames.flags))
        for k in range(9):
            if f[k] == 0:
                total, bright, count = total + a[k], bright + b[k], count + 1
            elif f[k] == int(Flag.NO_RETURN) and np.isfinite(a[k]):
                other, n_other = other + a[k], n_other + 1
        r = 0.0
        if count:
            r = float(measured_range_std(total / count, bright / count, frames.sensor)) ** 2
        for k in range(9):
            prior = p + (process_var_m2 / r if process_var_m2 and r else 0.0)
            if f[k] == 0 and p:
                gain = prior / (prior + 1)
                step = z[k] - x
                x, p = x + gain * (step - PERIOD_M * math.floor(step / PERIOD_M + 0.5)), gain
            elif f[k] == 0:
                x, p = z[k], 1.0
            elif p:
                p = prior
        mean = total / count if count else other / n_other if n_other else np.nan
        assert found.amplitude_e[i, row, col] == mean or (math.isnan(mean) and np.isnan(found.amplitude_e[i, row, col]))
        if found.state[i, row, col] == PixelState.RETURN:
            assert found.range_m[i, row, col] == x % PERIOD_M
            assert found.std_m[i, row, col] == math.sqrt(p * r)


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time])
@pytest.mark.parametrize("centre_m", [4.0, 0.0])
def test_without_amplitudes_the_variance_is_that_of_the_sample(run, centre_m):
    noise = np.random.default_rng(8).normal(0, 0.05, 20)
    filtered = run(series((centre_m + noise) % PERIOD_M))
    assert filtered.std_from_scatter
    assert filtered.amplitude_e is None
    assert filtered.std_m.item() == pytest.approx(noise.std(ddof=1) / math.sqrt(20), rel=1e-9)
    assert wrapped(filtered.range_m.item() - centre_m) == pytest.approx(noise.mean(), abs=1e-12)


def test_the_scatter_of_phasors_is_the_scatter_of_ranges_when_it_is_small():
    noise = np.random.default_rng(8).normal(0, 0.05, 20)
    filtered = phasor_mean(series(noise % PERIOD_M))
    # sin ψ for ψ costs the third order: ψ²/6 ≈ 7e-5 at 0.02 rad, a few times that for the largest
    assert filtered.std_m.item() == pytest.approx(noise.std(ddof=1) / math.sqrt(20), rel=1e-3)


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time, phasor_mean])
def test_a_single_frame_without_amplitude_does_not_know_its_noise(run):
    filtered = run(series([3.0, np.nan], valid=[True, False]))
    assert filtered.range_m.item() == pytest.approx(3.0, rel=1e-12)
    assert filtered.std_m.item() == math.inf


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time, phasor_mean])
def test_states_tell_return_no_return_and_missing_apart(run):
    dark, dead = int(Flag.NO_RETURN), int(Flag.MISSING | Flag.DEAD)
    flags = np.array(
        [
            [0, 0, 0, 0],
            [0, 0, dark, dark],
            [0, dark, dark, dark],
            [dark, dark, dark, dark],
            [0, dead, dead, dead],
            [dead, dead, dead, dark],
            [dead, dead, dead, dead],
        ]
    )
    sensor = sensor_of(1, len(flags))
    shape = (1, 4, 1, len(flags))
    amplitude_e = np.where(flags.T.reshape(shape) == 0, 5000.0, 10.0)
    frames = Frames(np.full(shape, 2.0), amplitude_e, np.full(shape, 2e4), sensor=sensor, flags=flags.T.reshape(shape))
    filtered = run(frames)
    R, N, M = PixelState.RETURN, PixelState.NO_RETURN, PixelState.MISSING
    np.testing.assert_array_equal(filtered.state[0, 0], [R, R, N, N, R, N, M])
    returned = filtered.state == R
    np.testing.assert_array_equal(np.isfinite(filtered.range_m), returned)
    np.testing.assert_array_equal(np.isfinite(filtered.std_m), returned)
    np.testing.assert_allclose(filtered.n_effective[0, 0], [4, 2, 0, 0, 1, 0, 0])
    # a pixel that never returned still says how dark it was
    np.testing.assert_allclose(filtered.amplitude_e[0, 0], [5000, 5000, 5000, 10, 5000, 10, np.nan])


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time, phasor_mean])
@pytest.mark.parametrize(("n_valid", "state"), [(3, PixelState.MISSING), (4, PixelState.RETURN)])
def test_a_pixel_that_is_missing_in_most_frames_is_missing(run, n_valid, state):
    # a chip that reports no target leaves open why; the few it reports there are noise above its threshold
    flags = np.zeros((1, 15, 1, 2), np.uint8)
    flags[:, n_valid:, :, 1] = Flag.MISSING
    values = np.full(flags.shape, 2.0)
    filtered = run(Frames(values, 2500 * values, 1e4 * values, sensor=sensor_of(1, 2), flags=flags))
    assert filtered.state[0, 0].tolist() == [PixelState.RETURN, state]
    # frames that are lost as a whole leave all pixels as they are
    flags[:, n_valid:] = Flag.MISSING
    filtered = run(Frames(values, 2500 * values, 1e4 * values, sensor=sensor_of(1, 2), flags=flags))
    assert filtered.state[0, 0].tolist() == [PixelState.RETURN, PixelState.RETURN]


@pytest.mark.parametrize("run", [kalman_filter, one_at_a_time])
@pytest.mark.parametrize("process_var_m2", [0.0, 1e-4])
def test_a_camera_without_noise_is_filtered_without_complaint(run, process_var_m2):
    frames = captured(3.0, 0.5, 5, shot_noise=False)
    filtered = run(frames, process_var_m2)
    np.testing.assert_allclose(filtered.range_m, 3.0, rtol=0, atol=1e-12)
    assert (filtered.std_m < 1e-7).all()  # an R of nothing, or 1e-12 of Q


def test_frame_by_frame_with_process_noise_approaches_the_batch_as_the_variance_settles():
    frames = captured(4.0, 0.5, 100, seed=9)
    batch, recursive = kalman_filter(frames, 1e-6), one_at_a_time(frames, 1e-6)
    # R of 100 frames is the same; of the gains only the early ones differ, by the per-cent of a few frames' mean
    np.testing.assert_allclose(recursive.std_m, batch.std_m, rtol=1e-3)
    assert np.abs(recursive.range_m - batch.range_m).max() < 0.01 * batch.std_m.min()


# --- the mean phasor ----------------------------------------------------------------------------------------------


def test_phasor_mean_is_the_argument_of_the_summed_phasors():
    frames = captured(4.0, 0.02, 10, max_phase_std_rad=None)
    filtered = phasor_mean(frames)
    phasors = frames.amplitude_e * np.exp(1j * frames.range_m / SENSOR.metres_per_radian)
    np.testing.assert_allclose(
        np.exp(1j * filtered.range_m / SENSOR.metres_per_radian),
        phasors.sum(axis=1) / np.abs(phasors.sum(axis=1)),
        rtol=1e-9,
    )
    np.testing.assert_allclose(filtered.amplitude_e, np.abs(phasors.mean(axis=1)), rtol=1e-12)
    np.testing.assert_array_equal(filtered.n_effective, 10)


@pytest.mark.parametrize("with_electrons", [True, False])
def test_phasor_mean_is_honest_at_low_signal(with_electrons):
    n_frames, size = 200, 48
    # σ_φ of one frame is 0.5 rad; of the mean 0.035 rad, where the law holds to 0.1 %
    amplitude = 1 / (2 * SENSOR.signal_e * (0.5 * 0.5) ** 2)
    frames = captured(7.0, amplitude, n_frames, seed=10, rows=size, cols=size, max_phase_std_rad=None)
    if not with_electrons:
        frames = Frames(frames.range_m, frames.amplitude_e, sensor=frames.sensor)
    filtered = phasor_mean(frames)
    assert filtered.std_from_scatter is not with_electrons
    # an estimated variance makes t of z: its mean square is ν/(ν − 2), 1 % more at 199 degrees of freedom
    inflation = 1.0 if with_electrons else (n_frames - 1) / (n_frames - 3)
    # 1 %: the amplitude of the mean phasor is known to 3.5 %, and its inverse square is 3 · 0.035² larger in the mean
    assert_honest(wrapped(filtered.range_m - 7.0), filtered.std_m, margin=0.01, inflation=inflation)


def test_phasor_mean_beats_the_mean_of_ranges_at_low_signal():
    amplitude = 1 / (2 * SENSOR.signal_e * (0.5 * 0.8) ** 2)  # σ_φ = 0.8 rad in one frame
    frames = captured(7.0, amplitude, 50, seed=11, rows=32, cols=32, max_phase_std_rad=None)

    def rms(filtered):
        return math.sqrt((wrapped(filtered.range_m - 7.0) ** 2).mean())

    assert rms(phasor_mean(frames)) < 0.9 * rms(kalman_filter(frames))


def test_phasor_mean_and_kalman_filter_agree_at_high_signal():
    frames = captured(4.0, 0.8, 50, seed=12)
    kalman_mean, mean = kalman_filter(frames), phasor_mean(frames)
    # weights differ by the amplitude's noise, 0.8 %, which moves the mean by that share of its own deviation
    assert np.abs(kalman_mean.range_m - mean.range_m).max() < 0.05 * mean.std_m.min()
    np.testing.assert_allclose(kalman_mean.std_m, mean.std_m, rtol=1e-3)


# --- containers and misuse ----------------------------------------------------------------------------------------


def test_filtered_frames_are_a_sequence_of_positions():
    sensor = sensor_of(2, 3)
    ranges = np.arange(4.0).reshape(4, 1, 1, 1) + 1 + np.zeros((4, 5, 2, 3))
    filtered = kalman_filter(Frames(ranges, sensor=sensor))
    assert len(filtered) == 4
    assert filtered[1].range_m.shape == (1, 2, 3)
    np.testing.assert_array_equal(filtered[[2, 0]].range_m[:, 0, 0], [3, 1])
    assert [len(one) for one in filtered] == [1, 1, 1, 1]
    assert filtered[1:].amplitude_e is None


def test_filtered_frames_refuse_shapes_that_disagree():
    ones = np.ones((1, 16, 16))
    state = np.zeros((1, 16, 16), np.uint8)
    with pytest.raises(
        UsageError, match=r"'std_m' must have shape \(n, rows, cols\) = \(1, 16, 16\), got \(1, 16, 8\)"
    ):
        FilteredFrames(ones, ones[..., :8], None, None, state, ones, SENSOR)


@pytest.mark.parametrize("bad", [-1e-9, math.nan, math.inf])
def test_a_negative_process_noise_is_refused(bad):
    with pytest.raises(UsageError, match="'process_var_m2' must be zero or positive"):
        kalman_filter(series([1.0]), bad)
    with pytest.raises(UsageError, match="'process_var_m2' must be zero or positive"):
        PixelKalman(SENSOR, bad)


@pytest.mark.parametrize("run", [kalman_filter, phasor_mean])
def test_nothing_to_filter_is_refused(run):
    with pytest.raises(UsageError, match="there is no frame to filter"):
        run(series([]))


def test_pixel_kalman_refuses_frames_unlike_the_ones_before():
    sensor = sensor_of(1, 1)
    recursive = PixelKalman(sensor)
    with pytest.raises(UsageError, match="call update"):
        recursive.result()
    with pytest.raises(UsageError, match="one frame at a time, got 2"):
        recursive.update(series([1.0, 1.0]))
    with pytest.raises(UsageError, match="another sensor"):
        recursive.update(Frames(np.ones((16, 16)), sensor=SENSOR))
    recursive.update(Frames([[1.0]], sensor=sensor))
    with pytest.raises(UsageError, match="2 positions, but the ones before have 1"):
        recursive.update(Frames(np.ones((2, 1, 1, 1)), sensor=sensor))
    with pytest.raises(UsageError, match="'amplitude_e' must come with every frame or none: given with the frame"):
        recursive.update(series([1.0], amplitude_e=[5.0]))
    assert recursive.result().n_effective.item() == 1  # what was refused left no trace


@pytest.mark.parametrize("spread", [0.0, 0.5, math.inf])
def test_variances_of_few_frames_and_a_law_add_up_as_their_scatter_about_it_allows(spread):
    """Factors 1 / χ²(d) · d on the law: mean squared errors over the variances are 1, and their weights are as good."""
    rng, pixels, nu = np.random.default_rng(3), 4000, 3
    d = {0.0: 1e9, 0.5: 8.0, math.inf: 0.3}[spread]
    law = np.exp(rng.normal(size=(1, pixels)))
    true = 2.5 * law * d / rng.chisquare(d, (1, pixels))
    sample = true * rng.chisquare(nu, (1, pixels)) / nu
    found, more = moderated(sample, np.full((1, pixels), float(nu)), law)
    if spread == 0.0:
        np.testing.assert_allclose(found, 2.5 * law, rtol=0.05)
        assert more[0] == pytest.approx(0.5 * stats.loggamma(nu / 2).var(), abs=0.05)
    elif spread == 0.5:
        assert np.mean(true / found) == pytest.approx(1.0, abs=0.05)
        assert np.mean(np.log(true / found) ** 2) < 0.5 * np.mean(np.log(true / sample) ** 2)
    else:  # the law says nothing: as the scatter, with the tails of Student's t
        assert np.median(found / sample) == pytest.approx(5 / 3, rel=0.15)
