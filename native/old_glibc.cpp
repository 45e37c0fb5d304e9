// Symbols that gcc 12 and glibc 2.34 need and manylinux_2_28 lacks. These replacements are hidden, so only this module uses
// them. parallel.cpp chooses the older of two versions of another function.
#include <new>

#if defined(__linux__) && defined(__GLIBCXX__)
#define POLARGUIDE_HIDDEN extern "C" __attribute__((visibility("hidden")))

// True if the process has only one thread; then counters of shared pointers need no atomic instructions.
POLARGUIDE_HIDDEN char polarguide_single_threaded __asm__("__libc_single_threaded");
char polarguide_single_threaded = 0;

// std::__throw_bad_array_new_length(): containers call it for sizes that cannot be addressed.
POLARGUIDE_HIDDEN [[noreturn]] void polarguide_bad_array_new_length() __asm__("_ZSt28__throw_bad_array_new_lengthv");
void polarguide_bad_array_new_length() { throw std::bad_array_new_length(); }

// std::exception_ptr counts references in two functions that older systems do not export. Its copy constructor and its
// destructor are public everywhere. The version in their names distinguishes these calls from the inline ones.
extern "C" void polarguide_copy_exception(void *to, const void *from);
extern "C" void polarguide_destroy_exception(void *pointer);
__asm__(".symver polarguide_copy_exception, _ZNSt15__exception_ptr13exception_ptrC1ERKS0_@CXXABI_1.3.3");
__asm__(".symver polarguide_destroy_exception, _ZNSt15__exception_ptr13exception_ptrD1Ev@CXXABI_1.3.3");

POLARGUIDE_HIDDEN void polarguide_add_reference(void *) __asm__("_ZNSt15__exception_ptr13exception_ptr9_M_addrefEv");
void polarguide_add_reference(void *pointer) {
    void *copy; // never destroyed, so the reference remains counted
    polarguide_copy_exception(&copy, pointer);
}

POLARGUIDE_HIDDEN void polarguide_release(void *) __asm__("_ZNSt15__exception_ptr13exception_ptr10_M_releaseEv");
void polarguide_release(void *pointer) { polarguide_destroy_exception(pointer); }

#endif
