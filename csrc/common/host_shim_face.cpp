// How tests choose the schedule of the host shim: torch.ops.snh_shim.set_schedule(n).
#include <torch/csrc/stable/library.h>

#include "common/host_shim.h"

static void set_schedule(int64_t schedule) { snh::shim::set_schedule(static_cast<uint64_t>(schedule)); }

STABLE_TORCH_LIBRARY_FRAGMENT(snh_shim, m) { m.def("set_schedule(int schedule) -> ()"); }
STABLE_TORCH_LIBRARY_IMPL(snh_shim, CompositeExplicitAutograd, m) {
  m.impl("set_schedule", TORCH_BOX(&set_schedule));
}
