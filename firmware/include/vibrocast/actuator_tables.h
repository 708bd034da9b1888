/* Actuators that ship; written by `python -m vibrocast.output.actuator_constants`. */
#ifndef VIBROCAST_ACTUATOR_TABLES_H
#define VIBROCAST_ACTUATOR_TABLES_H

#include "output.h"

#ifdef __cplusplus
extern "C" {
#endif
#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

/* cffi: begin */
/* piezo-stack, DAC of 16 bits at 3000 Hz. */
extern const vc_actuator vc_piezo_stack;
/* piezo-stack, DAC of 12 bits at 3000 Hz. */
extern const vc_actuator vc_piezo_stack_12_bits;
/* lra, DAC of 16 bits at 8000 Hz. */
extern const vc_actuator vc_lra;
/* voice-coil, DAC of 16 bits at 8000 Hz. */
extern const vc_actuator vc_voice_coil;
/* cffi: end */

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif

#endif
