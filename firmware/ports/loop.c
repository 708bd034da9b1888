/* The loop that runs a controller on any port. */
#include "vibrocast/port.h"
#include "../src/controller/vc_controller_memory.h"

#define VC_PIECE_BYTES 256 /* in one read or write */

static vc_controller controller;
static uint8_t outgoing[VC_PIECE_BYTES];
static size_t filled, sent; /* bytes of `outgoing` */

int vc_loop_start(const vc_controller_settings *settings, const vc_flash *flash, const vc_dac_port *dac)
{
    return vc_controller_init(&controller, settings, flash, dac, vc_port_now_us());
}

int vc_loop_turn(void)
{
    uint8_t incoming[VC_PIECE_BYTES];
    size_t came = vc_port_read(incoming, sizeof incoming), went;
    uint64_t now_us = vc_port_now_us();
    int behind;
    if (came > 0)
        behind = vc_controller_receive(&controller, incoming, came, now_us);
    else
        behind = vc_controller_advance(&controller, now_us);
    if (sent == filled) {
        filled = vc_controller_transmit(&controller, outgoing, sizeof outgoing);
        sent = 0;
    }
    went = vc_port_write(outgoing + sent, filled - sent);
    sent += went;
    return came > 0 || went > 0 || behind;
}
