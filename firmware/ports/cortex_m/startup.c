/* From reset to main. */
#include "cortex_m.h"

extern const uint32_t vc_data_load[];
extern uint32_t vc_data_start[], vc_data_end[], vc_bss_start[], vc_bss_end[];

void Reset_Handler(void)
{
    const uint32_t *from = vc_data_load;
    uint32_t *to;
#ifdef __ARM_FP
    VC_COPROCESSORS |= 0xFu << 20; /* CP10 and CP11, the FPU: the compiler keeps integers in its registers */
    __asm volatile("dsb\nisb" ::: "memory");
#endif
    for (to = vc_data_start; to < vc_data_end;)
        *to++ = *from++;
    for (to = vc_bss_start; to < vc_bss_end;)
        *to++ = 0;
    main();
    for (;;) {
    }
}
