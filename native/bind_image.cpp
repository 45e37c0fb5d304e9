#include <nanobind/nanobind.h>
void bind_image(nanobind::module_ &) {}
