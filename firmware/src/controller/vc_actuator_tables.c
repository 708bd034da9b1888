/* Actuators that ship; written by `python -m vibrocast.output.actuator_constants`. */
#include "vibrocast/actuator_tables.h"

const vc_actuator vc_piezo_stack = {
    .name = "piezo-stack",
    .stroke_um = 1117782016,
    .volts = 1125515264,
    .lower_hz = 0,
    .upper_hz = 1132920832,
    .slew_volts_per_second = 1217559552,
    .dac_rate_hz = 3000,
    .dac_bits = 16,
    .codes_per_um_exponent = -21,
    .codes_per_um_mantissa = 1717986918,
    .code_limit = 32767,
    .code_step_limit = 43690,
    .power_limit = 697932185,
    .compensation = {
        .tangent = 478060661,
        .damping = 136548215,
        .gain = 381864805,
        .weight = {0, 19649233, 16777216, 19649233},
        .shift = 0,
    },
};

const vc_actuator vc_piezo_stack_12_bits = {
    .name = "piezo-stack",
    .stroke_um = 1117782016,
    .volts = 1125515264,
    .lower_hz = 0,
    .upper_hz = 1132920832,
    .slew_volts_per_second = 1217559552,
    .dac_rate_hz = 3000,
    .dac_bits = 12,
    .codes_per_um_exponent = -25,
    .codes_per_um_mantissa = 1717986918,
    .code_limit = 2047,
    .code_step_limit = 2730,
    .power_limit = 697932185,
    .compensation = {
        .tangent = 478060661,
        .damping = 136548215,
        .gain = 381864805,
        .weight = {0, 19649233, 16777216, 19649233},
        .shift = 0,
    },
};

const vc_actuator vc_lra = {
    .name = "lra",
    .stroke_um = 1128792064,
    .volts = 1085485875,
    .lower_hz = 1126777740,
    .upper_hz = 1127542327,
    .slew_volts_per_second = 1183412694,
    .dac_rate_hz = 8000,
    .dac_bits = 16,
    .codes_per_um_exponent = -22,
    .codes_per_um_mantissa = 1374389535,
    .code_limit = 32767,
    .code_step_limit = 25735,
    .power_limit = 214748364,
    .compensation = {
        .tangent = 36953217,
        .damping = 40410546,
        .gain = 1031009182,
        .weight = {134217728, 8947849, 134217728, 0},
        .shift = 0,
    },
};

const vc_actuator vc_voice_coil = {
    .name = "voice-coil",
    .stroke_um = 1137180672,
    .volts = 1090519040,
    .lower_hz = 1117289374,
    .upper_hz = 1121221534,
    .slew_volts_per_second = 1187273084,
    .dac_rate_hz = 8000,
    .dac_bits = 16,
    .codes_per_um_exponent = -23,
    .codes_per_um_mantissa = 1374389535,
    .code_limit = 32767,
    .code_step_limit = 25735,
    .power_limit = 214748364,
    .compensation = {
        .tangent = 18982489,
        .damping = 181329782,
        .gain = 980105303,
        .weight = {134217728, 44739243, 134217728, 0},
        .shift = 0,
    },
};
