"""Two pools side by side, whose functions ask for different amounts of memory."""

from __future__ import annotations

import fiber


@fiber.meta(memory=160)
def small(number: int) -> int:
    return number + 1


@fiber.meta(memory=192)
def large(number: int) -> int:
    return number + 2


def main() -> None:
    """Map over pools of two shapes, and check the results."""
    with fiber.Pool(2) as few, fiber.Pool(2) as many:
        results = [few.map_async(small, range(20)), many.map_async(large, range(20))]
        assert [result.get() for result in results] == [[*range(1, 21)], [*range(2, 22)]]


if __name__ == "__main__":
    main()
