/* The output by a haptic driver at GPIO4 (SDA) and GPIO5 (SCL), one channel. RP2040 datasheet: 4.3. */
#include "vibrocast/actuator_tables.h"
#include "board.h"
#include "drv260x.h"
#include "paced_output.h"
#include "vibrocast/port.h"

#define I2C_HZ 400000u
#define FIRST_PIN 4u
#define PINS 2u
#define BITS 8
#define FIFO_ENTRIES 16u

const vc_actuator *const vc_output_actuator = &VC_ACTUATOR(vc_lra);
const unsigned vc_output_line = VC_PWM_LINE;

/* Sends a register of the driver. Refuses where bytes of earlier ones still wait, because the driver holds the bus, and
 * where it has not acknowledged: the port throws bytes away until that is cleared (4.3.17). */
VC_IN_RAM static int write_register(uint8_t address, uint8_t value)
{
    if (VC_I2C_RAW_INTR_STAT & VC_I2C_TX_ABRT) {
        (void)VC_I2C_CLR_TX_ABRT;
        return 0;
    }
    if (VC_I2C_TXFLR + 2 > FIFO_ENTRIES)
        return 0;
    VC_I2C_DATA_CMD = address;
    VC_I2C_DATA_CMD = value | VC_I2C_STOP;
    return 1;
}

/* For an LRA whose response the controller compensates. The two voltages are those of a driver after power-up: set
 * them for your actuator. */
static const vc_drv260x driver = {
    .mode = VC_DRV260X_WAVEFORM,
    .rated_voltage = 0x3E,
    .overdrive_clamp = 0x8C,
    .write = write_register,
    .counts = &vc_paced_counts,
};

/* 4.3.14.1: the clock is low for three fifths of its period. */
static void start_i2c(void)
{
    const uint32_t cycles = VC_PROCESSOR_HZ / I2C_HZ, low = cycles * 3 / 5;
    unsigned pin;
    vc_board_enable(VC_RESET_I2C0);
    VC_I2C_ENABLE = 0;
    VC_I2C_CON = VC_I2C_MASTER_FAST;
    VC_I2C_TAR = VC_DRV260X_ADDRESS;
    VC_I2C_FS_HCNT = cycles - low;
    VC_I2C_FS_LCNT = low;
    VC_I2C_FS_SPKLEN = low / 16;
    VC_I2C_SDA_HOLD = VC_PROCESSOR_HZ / 1000000 * 3 / 10 + 1; /* 0.3 us */
    VC_I2C_INTR_MASK = 0;
    VC_I2C_ENABLE = 1;
    for (pin = FIRST_PIN; pin < FIRST_PIN + PINS; pin++) {
        VC_GPIO_PAD(pin) = VC_PAD_INPUT | VC_PAD_PULL_UP | VC_PAD_SCHMITT | VC_PAD_4_MA;
        VC_GPIO_CTRL(pin) = VC_GPIO_I2C;
    }
}

void vc_output_start(void)
{
    vc_paced_start(vc_output_actuator->dac_rate_hz, vc_output_actuator->dac_bits - BITS);
    vc_board_enable(VC_RESET_PWM);
    start_i2c();
    vc_drv260x_start(&driver, vc_output_actuator->dac_rate_hz);
    vc_sample_clock_start(vc_output_actuator->dac_rate_hz, 0);
}

void vc_output_interrupt(void)
{
    vc_sample_clock_clear();
    vc_drv260x_sample(vc_paced_next()[0]);
}

void vc_output_rest(void)
{
    for (;;) {
        volatile uint32_t turns;
        vc_drv260x_sample(vc_paced_rest()[0]);
        for (turns = 0; turns < 10000; turns++) { /* longer than a write takes */
        }
    }
}
