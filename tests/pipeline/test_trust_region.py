import numpy as np

from pipeline.trust_region import SearchParameters, descend, trust_region_step


def test_steps_are_the_minimum_inside_the_radius():
    rng = np.random.default_rng(4)
    for _ in range(40):
        A = rng.normal(size=(6, 6))
        B, g, radius = A @ A.T + 0.01 * np.eye(6), rng.normal(size=6), rng.uniform(0.05, 3)
        step = trust_region_step(B, g, radius)
        assert np.linalg.norm(step) <= radius * (1 + 1e-6)
        value = g @ step + 0.5 * step @ B @ step
        others = rng.normal(size=(3000, 6))
        others *= radius * rng.uniform(0, 1, (3000, 1)) ** (1 / 6) / np.linalg.norm(others, axis=1)[:, None]
        assert value <= (others @ g + 0.5 * np.einsum("ni,ij,nj->n", others, B, others)).min() + 1e-9
        if np.linalg.norm(np.linalg.solve(B, g)) < radius:
            np.testing.assert_allclose(step, -np.linalg.solve(B, g), rtol=1e-6)


def test_descent_finds_the_valley_of_rosenbrock():
    def rosenbrock(x):
        value = sum(100 * (x[i + 1] - x[i] ** 2) ** 2 + (1 - x[i]) ** 2 for i in range(5))
        gradient = np.zeros(6)
        for i in range(5):
            gradient[i] += -400 * x[i] * (x[i + 1] - x[i] ** 2) - 2 * (1 - x[i])
            gradient[i + 1] += 200 * (x[i + 1] - x[i] ** 2)
        return value, gradient

    patient = SearchParameters(most_steps=500, least_step=1e-7)
    start = np.zeros(6)
    begin = rosenbrock(start)
    found, value = descend(rosenbrock, start, begin, np.eye(6), 1.0, patient)
    assert value == rosenbrock(found)[0]
    np.testing.assert_allclose(found, 1, atol=1e-3)
