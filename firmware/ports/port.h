/* What a port provides, and the loop that runs a controller on it.
 *
 * A port has a main() that sets its hardware up, calls vc_loop_start once and vc_loop_turn for ever, at least every
 * few milliseconds; and the four functions at the end of this file, which the loop calls. README.md has the order.
 */
#ifndef VIBROCAST_PORT_H
#define VIBROCAST_PORT_H

#include "controller.h"

#define VC_BUILD "vibrocast firmware 0.1.0"

/* Starts the controller. `settings` and `flash` must stay valid. */
void vc_loop_start(const vc_controller_settings *settings, const vc_flash *flash);

/* Passes on what has come from the host, plays what is due, and passes on what goes to the host. Returns 0 when there
 * was nothing to pass on: the port may then wait for the next byte, or a few milliseconds. */
int vc_loop_turn(void);

/* Moves up to `capacity` bytes from the host into `data`; returns how many there were. Never waits. */
size_t vc_port_read(uint8_t *data, size_t capacity);

/* Takes up to `length` bytes for the host; returns how many there was room for. Never waits. */
size_t vc_port_write(const uint8_t *data, size_t length);

/* A clock in microseconds that never goes back, from any start. The DAC and it must go by the same oscillator. */
uint64_t vc_port_now_us(void);

/* The controller's DAC sink; `context` is NULL. Called within vc_loop_turn, with all codes that were due when the turn
 * began, in pieces; after what was decoded for them, which is when they come late. A stop's way to rest comes at once,
 * some 5 ms ahead of time. */
void vc_port_play(void *context, const int16_t *codes, uint32_t samples, unsigned channels);

#endif
