"""The course of a training: the means of its losses over stretches of steps, kept as it goes on."""

COURSE = 100  # steps, whose mean is a point of the course; the last may have fewer


def record(course: list[float], step: int, value: float) -> None:
    """Adds what the step after `step` others lost."""
    done = step % COURSE
    if not done:
        course.append(0.0)
    course[-1] += (value - course[-1]) / (done + 1)
