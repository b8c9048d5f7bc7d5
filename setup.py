"""Compile `torchid/kernels/*.cpp` while torchid is installed; without a C++ compiler it is installed all the same."""

import os
import platform
from pathlib import Path
from zlib import crc32

from setuptools import Extension, setup

kernels = Path("torchid/kernels")
sources = sorted(path.as_posix() for pattern in ("*.cpp", "*.h") for path in kernels.glob(pattern))
checksum = crc32(b"".join(Path(path).read_bytes() for path in sources))
arm = platform.machine().lower() in ("arm64", "aarch64")
march = os.environ.get("TORCHID_MARCH")  # wheels run on other processors than the one that builds them
setup(
    ext_modules=[
        Extension(
            "torchid.kernels._compiled",
            [path for path in sources if path.endswith(".cpp")],
            depends=sources,
            language="c++",
            optional=True,
            define_macros=[("TORCHID_CHECKSUM", f"{checksum}u")],
            extra_compile_args=[
                *("-std=c++17", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
                *("-pthread", "-g0", "-Wno-psabi", "-Wall", "-Wextra"),
                f"-march={march}" if march else "-mcpu=native" if arm else "-march=native",
            ],
            extra_link_args=["-pthread"],
        )
    ]
)
