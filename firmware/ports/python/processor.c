/* Asks the processor by CPUID, and by XGETBV whether the operating system keeps the registers of AVX. */
#include "processor.h"

#ifdef __x86_64__
#include <cpuid.h>
#endif

#define VC_OSXSAVE (1u << 27)
/* SSE3, SSSE3, FMA, CMPXCHG16B, SSE4.1, SSE4.2, MOVBE, POPCNT, OSXSAVE, AVX, F16C */
#define VC_LEAF_1_ECX                                                                                                  \
    (1u | 1u << 9 | 1u << 12 | 1u << 13 | 1u << 19 | 1u << 20 | 1u << 22 | 1u << 23 | VC_OSXSAVE | 1u << 28 | 1u << 29)
#define VC_LEAF_7_EBX (1u << 3 | 1u << 5 | 1u << 8) /* BMI1, AVX2, BMI2 */
#define VC_LEAF_80000001_ECX (1u | 1u << 5)         /* LAHF, LZCNT */
#define VC_XCR0 (1u << 1 | 1u << 2)                 /* XMM, YMM */

int vc_registers_run_x86_64_v3(uint32_t leaf_1_ecx, uint32_t leaf_7_ebx, uint32_t leaf_80000001_ecx, uint32_t xcr0)
{
    return (leaf_1_ecx & VC_LEAF_1_ECX) == VC_LEAF_1_ECX && (leaf_7_ebx & VC_LEAF_7_EBX) == VC_LEAF_7_EBX &&
           (leaf_80000001_ecx & VC_LEAF_80000001_ECX) == VC_LEAF_80000001_ECX && (xcr0 & VC_XCR0) == VC_XCR0;
}

int vc_runs_x86_64_v3(void)
{
#ifdef __x86_64__
    unsigned eax, ebx, ecx, edx, leaf_1_ecx, leaf_7_ebx, xcr0, high;
    /* The processor must have a leaf before it is asked, and OSXSAVE before XGETBV. */
    if (!__get_cpuid(1, &eax, &ebx, &leaf_1_ecx, &edx) || !(leaf_1_ecx & VC_OSXSAVE))
        return 0;
    if (!__get_cpuid_count(7, 0, &eax, &leaf_7_ebx, &ecx, &edx) || !__get_cpuid(0x80000001u, &eax, &ebx, &ecx, &edx))
        return 0;
    __asm__ volatile("xgetbv" : "=a"(xcr0), "=d"(high) : "c"(0));
    return vc_registers_run_x86_64_v3(leaf_1_ecx, leaf_7_ebx, ecx, xcr0);
#else
    return 0;
#endif
}
