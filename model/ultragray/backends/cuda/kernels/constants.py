"""Numbers of the forward model, and the shapes of what the kernels hand to each other."""

import triton.language as tl

MAX_M2 = tl.constexpr(11.0825270903)  # -2 log(1/255): w and alpha are under 1/255 beyond
MAX_M2_ATTENUATION = tl.constexpr(9.0)
MAX_WEIGHT = tl.constexpr(0.999)
MIN_PSI = tl.constexpr(0.0039292930)  # -log(1 - 1/255): alpha reaches 1/255
FULL_PROFILE = tl.constexpr(2.8906850)  # G(u) for u >= 3
NEGLIGIBLE = tl.constexpr(24.0)  # w < 7e-6 beyond m2 + u2: dozens of such tails on a pixel still do not show
EARLY_SIGMA_CM = tl.constexpr(1.8)  # an opaque Gaussian wider than this absorbs 1/255 above the rows where w does
MIN_VARIANCE_CM2 = tl.constexpr(1e-32)  # thinner ones touch no row
LOG2_E = tl.constexpr(1.4426950408889634)  # the hardware's exponential has base 2
HALF_LOG2_E = tl.constexpr(0.7213475204444817)  # exp(-x2 / 2) is exp2(-HALF_LOG2_E x2)
NODE = tl.constexpr(0.7745966692414834)  # Gauss-Legendre: nodes 0, +-sqrt(0.6)

# Of a pose: axes 9, origin 3, near, cull_far, row_cm, start and span of the scan lines, and the beam's variance by
# depth: at the focus, the focus, the square of its slope, the most.
VIEW = tl.constexpr(21)
FIELDS = tl.constexpr(12)  # of a slice: t, row offset, r, m2, tt, tr, rr, det, intensity, 1 - tau; to whole 16 bytes
RECTANGLE = tl.constexpr(8)  # of a slice: first and last column and row, own column and row, clipped; likewise
GRADIENTS = tl.constexpr(9)  # by a slice's t, r, tt, tr, rr, m2, intensity, 1 - tau, det
SPARE_LINES = tl.constexpr(15)  # what a footprint costs beside its pixels, as on the CPU (model/kernels/footprint.cpp)
SPARE_ROWS = tl.constexpr(16)
CLIPPED_COST = tl.constexpr(8)
NOTHING = tl.constexpr(1 << 30)  # larger than every block, row and column
