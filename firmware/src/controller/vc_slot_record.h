/* The record of the slots' states: a log in flash that is erased only when it is full.
 *
 * Entries are appended to one of the flash's two record pieces. When that is full, the other piece is erased and
 * continues. The newest whole entry counts, so a power cut leaves either the entry before or the one after.
 */
#ifndef VIBROCAST_SLOT_RECORD_H
#define VIBROCAST_SLOT_RECORD_H

#include "vibrocast/settings.h"
#include "../core/vc_sha256.h"

#define VC_SLOTS 2
/* Bytes of an entry, which takes whole writes of the flash: a record piece holds at least one. */
#define VC_SLOT_ENTRY_BYTES 92

/* cffi: begin */
typedef struct {
    uint8_t state;  /* enum vc_slot_state */
    uint8_t booted; /* a slot on trial has been started once */
    uint32_t size_bytes;
    uint8_t sha256[32];
} vc_slot;

/* An entry. `lowest_number`: images below this number are rejected; the highest one confirmed so far. */
typedef struct {
    vc_slot slots[2];
    uint32_t lowest_number;
} vc_slot_entry;

typedef struct {
    const vc_flash *flash;
    vc_slot_entry entry; /* the newest one; zeros where there is none */
    uint32_t counter;    /* of the last entry that was begun */
    unsigned newest;     /* the piece that holds the newest entry */
    unsigned piece;      /* the piece that takes the next entry */
    uint32_t place;      /* its place there, in entries */
} vc_slot_record;

/* Reads the newest entry. `flash` must stay valid. */
void vc_slot_record_open(vc_slot_record *record, const vc_flash *flash);

/* Appends an entry, which `record` then has. Returns whether the flash took it. */
int vc_slot_record_append(vc_slot_record *record, const vc_slot_entry *entry);
/* cffi: end */

#endif
