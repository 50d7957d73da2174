import re

from torchrl_mcp.report.paper import METHODS, PLACES, TABLE_2

PRINTED = """
Heading: Biped	0.927±0.032	0.970±0.002	0.834±0.001	0.952±0.012	0.918±0.002	0.970±0.001	0.976±0.002
Heading: Humanoid	0.965±0.010	0.975±0.008	0.681±0.006	0.958±0.001	0.857±0.018	0.969±0.002	0.970±0.003
Heading: T-Rex	0.840±0.003	0.953±0.004	-	0.830±0.004	0.672±0.011	0.686±0.003	0.932±0.007
Carry: Biped	0.027±0.035	0.324±0.014	0.001±0.002	0.346±0.011	0.013±0.013	0.456±0.031	0.575±0.032
Dribble: Biped	0.072±0.012	0.651±0.025	0.546±0.024	0.046±0.008	0.073±0.021	0.768±0.012	0.782±0.008
Dribble: Humanoid	0.076±0.024	0.598±0.030	0.198±0.002	0.058±0.007	0.043±0.021	0.751±0.006	0.805±0.006
Dribble: T-Rex	0.065±0.032	0.074±0.011	-	0.098±0.013	0.070±0.017	0.115±0.013	0.781±0.021
Holdout: Ant	0.951±0.093	0.885±0.062	-	-	-	0.745±0.060	0.812±0.030
""".strip().splitlines()


def test_table_2_holds_every_figure_that_is_printed_and_no_other():
    printed = {}
    for line in PRINTED:
        place, *figures = line.split("\t")
        task, character = place.lower().replace("-", "").split(": ")
        for method, figure in zip(METHODS, figures, strict=True):
            if figure != "-":
                printed[task, character, method] = tuple(map(float, re.findall(r"[\d.]+", figure)))
    assert {key: tuple(value) for key, value in TABLE_2.items()} == printed
    assert list(dict.fromkeys((task, character) for task, character, _ in printed)) == PLACES
