"""Drawings: ``python docs/pictures/diagram.py`` writes ``mcp.svg`` and ``architecture.svg`` beside itself.

Every text stands on a pale box and every arrow is grey, so that the picture can be read on white and on black.
"""

import math
from pathlib import Path

PALETTE = {"input": "#dbe4ee", "primitives": "#cfe8d5", "gate": "#fbe3c4", "product": "#e4daf3"}
CURVES = ((0.15, 0.05), (0.35, 0.09), (0.5, 0.04), (0.62, 0.12), (0.8, 0.06))
"""Centre and width of the primitives' bells, as shares of their box."""
FORMULA = "π(a | s, g) = 1/Z ∏ πᵢʷⁱ"

STYLE = "font-family='Helvetica, Arial, sans-serif' fill='#1b1f24'"


def box(x: int, y: int, width: int, height: int, kind: str, *lines: str) -> str:
    """Return a box with lines of text, the first of which is bold."""
    texts = [
        f"<text x='{x + width / 2}' y='{y + 24 + 20 * number}' text-anchor='middle' font-size='15' {STYLE} "
        f"font-weight='{'normal' if number else 'bold'}'>{line}</text>"
        for number, line in enumerate(lines)
    ]
    shape = f"<rect x='{x}' y='{y}' width='{width}' height='{height}' rx='8' fill='{PALETTE[kind]}' stroke='#8b949e'/>"
    return shape + "".join(texts)


def arrow(*points: tuple[int, int]) -> str:
    """Return an arrow along points."""
    way = " ".join(f"{x},{y}" for x, y in points)
    return f"<polyline points='{way}' fill='none' stroke='#8b949e' stroke-width='2.5' marker-end='url(#tip)'/>"


def bells(x: int, y: int, width: int, height: int) -> str:
    """Return bell curves side by side, one for each primitive that is drawn."""
    paths = []
    for centre, spread in CURVES:
        points = []
        for step in range(61):
            share = step / 60
            rise = 0.038 / spread * math.exp(-((share - centre) ** 2) / (2 * spread**2))
            points.append(f"{x + width * share:.1f},{y + height * (1 - min(rise, 1)):.1f}")
        paths.append(f"<polyline points='{' '.join(points)}' fill='none' stroke='#2f6f46' stroke-width='1.5'/>")
    return "".join(paths)


def bars(x: int, y: int, width: int, height: int) -> str:
    """Return the weights of eight primitives as bars."""
    weights = (0.9, 0.1, 0.55, 0.0, 0.3, 0.75, 0.05, 0.4)
    step = width / len(weights)
    return "".join(
        f"<rect x='{x + step * number + 2:.1f}' y='{y + height * (1 - weight):.1f}' width='{step - 4:.1f}' "
        f"height='{max(height * weight, 1):.1f}' fill='#b06a12'/>"
        for number, weight in enumerate(weights)
    )


def picture(title: str, width: int, height: int, *parts: str) -> str:
    """Return a picture as SVG."""
    return "\n".join(
        [
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}' role='img' aria-label='{title}'>",
            "<defs><marker id='tip' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='5' markerHeight='5' "
            "orient='auto'><path d='M0,0 L8,4 L0,8 z' fill='#8b949e'/></marker></defs>",
            *parts,
            "</svg>\n",
        ]
    )


def idea() -> str:
    """Return the drawing of the idea."""
    return picture(
        "The state goes to eight primitives, state and goal to the gate; their product is the policy",
        780,
        250,
        box(8, 40, 96, 40, "input", "state s"),
        box(8, 168, 96, 40, "input", "goal g"),
        box(168, 8, 230, 112, "primitives", "8 primitives πᵢ(a | s)", "imitate motions, then frozen"),
        bells(188, 58, 190, 52),
        box(168, 134, 230, 108, "gate", "gate w(s, g)", "trained anew for every task"),
        bars(218, 184, 130, 48),
        box(462, 72, 178, 104, "product", "product", FORMULA, "one Gaussian again", "trained with PPO"),
        box(700, 104, 72, 40, "input", "action"),
        arrow((104, 60), (166, 60)),
        arrow((104, 188), (166, 188)),
        arrow((136, 60), (136, 164), (166, 164)),
        arrow((398, 64), (430, 64), (430, 108), (460, 108)),
        arrow((398, 188), (430, 188), (430, 140), (460, 140)),
        arrow((640, 124), (698, 124)),
    )


def architecture() -> str:
    """Return the drawing of how data flow from a command to a gradient."""
    return picture(
        "From a command over the configuration to environments, agent and objective, which the loop trains",
        780,
        470,
        box(8, 8, 230, 64, "input", "command", "commands/train.py, conf/*.yaml"),
        box(290, 8, 200, 64, "input", "plan and checks", "runs/experiment.py"),
        box(572, 8, 200, 64, "input", "builder", "runs/build.py"),
        arrow((238, 40), (288, 40)),
        arrow((490, 40), (570, 40)),
        box(
            8,
            122,
            230,
            104,
            "primitives",
            "environments",
            "envs/tasks/*.py: goal, reward",
            "envs/base.py: steps, resets",
            "envs/physics/: MuJoCo",
        ),
        box(
            275,
            122,
            230,
            104,
            "gate",
            "agent",
            "methods/*.py: actor",
            "modules/: networks",
            "distributions/: product, sum",
        ),
        box(
            542,
            122,
            230,
            104,
            "product",
            "objective",
            "objectives/ppo.py: losses",
            "objectives/advantages.py",
            "conf/optimizer: Adam",
        ),
        arrow((672, 72), (672, 98), (123, 98), (123, 120)),
        arrow((672, 72), (672, 98), (390, 98), (390, 120)),
        arrow((672, 72), (672, 120)),
        box(8, 282, 764, 40, "input", "the loop: training/trainer.py"),
        arrow((123, 226), (123, 280)),
        arrow((390, 226), (390, 280)),
        arrow((657, 226), (657, 280)),
        box(8, 362, 230, 84, "primitives", "collect", "training/collectors.py", "N environments × T steps"),
        box(275, 362, 230, 84, "product", "update", "training/update.py", "advantages, losses, steps"),
        box(542, 362, 230, 84, "input", "record", "training/metrics.py", "training/checkpoint.py"),
        arrow((123, 322), (123, 360)),
        arrow((238, 404), (273, 404)),
        arrow((505, 404), (540, 404)),
        arrow((657, 362), (657, 324)),
    )


if __name__ == "__main__":
    for name, draw in (("mcp", idea), ("architecture", architecture)):
        Path(__file__).with_name(f"{name}.svg").write_text(draw(), encoding="utf-8")
