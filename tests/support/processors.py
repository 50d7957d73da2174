"""The tests of trajectories as on other processors: other kernels, other roundings, other seeds.

    python tests/support/processors.py [--perturbations 20]

A trained policy in a loop with physics is chaotic: a rounding of the last bit gives other trajectories after a second.
So the tests that are marked with ``trajectories`` have bounds from distributions. This command runs them with the
kernels of other processors, with more threads, in bfloat16, with other seeds, and with first observations that differ
by a relative 1e-7: twenty of these perturbations are the surest stand-in for a processor that is not at hand. Kernels
whose instructions this processor lacks are left out, and the output names them.
"""

import argparse
import os
import subprocess
import sys

import torch

PYTEST = (sys.executable, "-m", "pytest", "-m", "trajectories and not slow", "-q", "-n", "2", "--no-header")
VARIANTS: tuple[tuple[dict[str, str], tuple[str, ...]], ...] = (
    ({"ATEN_CPU_CAPABILITY": "default"}, ()),
    ({"ATEN_CPU_CAPABILITY": "avx2"}, ()),
    ({"ATEN_CPU_CAPABILITY": "avx512"}, ()),
    ({"ONEDNN_MAX_CPU_ISA": "SSE41"}, ()),
    ({"ONEDNN_MAX_CPU_ISA": "AVX2"}, ()),
    ({"MKL_CBWR": "COMPATIBLE"}, ()),
    ({"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA"}, ()),  # sines and cosines of the physics
    ({"OMP_WAIT_POLICY": "PASSIVE"}, ("--threads=2",)),  # two workers with two threads each would spin
    ({}, ("--bfloat16",)),
    ({}, ("--shift-seeds=1",)),
)
"""Variables of the environment and options of pytest."""


def main() -> None:
    """Run the tests in every variant, print a line for each, and end with 1 if any failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--perturbations", type=int, default=20, help="changes of the last bit (default: 20)")
    perturbations: tuple[dict[str, str], tuple[str, ...]] = (
        {},
        (f"--perturbations={parser.parse_args().perturbations}",),
    )
    failures = 0
    for variables, options in (*VARIANTS, perturbations):
        name = " ".join([*(f"{key}={value}" for key, value in variables.items()), *options])
        if missing_instructions(variables):
            print(f"{name}: left out, because this processor lacks these instructions", flush=True)
            continue
        done = subprocess.run([*PYTEST, *options], env={**os.environ, **variables}, capture_output=True, text=True)
        lines = done.stdout.splitlines()
        print(f"{name}: {lines[-1] if lines else f'status {done.returncode} {done.stderr}'}", flush=True)
        if done.returncode:
            failures += 1
            print("\n".join(line for line in lines if line.startswith(("FAILED", "ERROR", "E  "))), flush=True)
    sys.exit(1 if failures else 0)


def missing_instructions(variables: dict[str, str]) -> bool:
    """Return whether PyTorch's kernels would use instructions that this processor lacks: PyTorch does not check."""
    own = torch.backends.cpu.get_cpu_capability()
    return variables.get("ATEN_CPU_CAPABILITY") == "avx512" and "AVX512" not in own.upper()


if __name__ == "__main__":
    main()
