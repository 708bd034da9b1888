/* The record of the slots' states; see vc_slot_record.h. */
#include "vc_slot_record.h"

#include "../core/vc_common.h"
#include "../core/vc_crc.h"
#include "../core/vc_fields.h"
#include "vibrocast/protocol.h"

/* Entry: "VCSR", counter u32, lowest number u32, of each slot state u8, booted u8, size u32 and SHA-256, then CRC-32.
 */
enum { MAGIC_BYTES = 4, CRC_BYTES = 4, CHECKED_BYTES = VC_SLOT_ENTRY_BYTES - CRC_BYTES };

static const uint8_t magic[MAGIC_BYTES] = {'V', 'C', 'S', 'R'};

/* From one entry to the next: whole writes of the flash. */
static uint32_t place_bytes(const vc_flash *flash)
{
    return (VC_SLOT_ENTRY_BYTES + flash->write_bytes - 1) / flash->write_bytes * flash->write_bytes;
}

static uint32_t places(const vc_flash *flash)
{
    return flash->record_bytes / place_bytes(flash);
}

static uint32_t place_offset(const vc_flash *flash, unsigned piece, uint32_t place)
{
    return flash->record[piece] + place * place_bytes(flash);
}

static int is_blank(const uint8_t *bytes, size_t length)
{
    while (length > 0 && bytes[length - 1] == 0xFF)
        length--;
    return length == 0;
}

/* Takes an entry if it is whole and newer than the last one. Returns whether it did. */
static int read_entry(vc_slot_record *record, const uint8_t *bytes)
{
    vc_fields fields;
    vc_slot_entry entry;
    uint32_t counter;
    unsigned i;
    if (!vc_same_bytes(bytes, magic, MAGIC_BYTES) ||
        vc_crc32(bytes, CHECKED_BYTES, 0) != vc_number(bytes + CHECKED_BYTES, CRC_BYTES))
        return 0;
    vc_fields_begin(&fields, bytes + MAGIC_BYTES, CHECKED_BYTES - MAGIC_BYTES);
    counter = (uint32_t)vc_take_number(&fields, 4);
    entry.lowest_number = (uint32_t)vc_take_number(&fields, 4);
    for (i = 0; i < VC_SLOTS; i++) {
        vc_slot *slot = &entry.slots[i];
        slot->state = (uint8_t)vc_take_number(&fields, 1);
        slot->booted = (uint8_t)vc_take_number(&fields, 1);
        slot->size_bytes = (uint32_t)vc_take_number(&fields, 4);
        memcpy(slot->sha256, vc_take_piece(&fields, VC_SHA256_BYTES).bytes, VC_SHA256_BYTES);
        if (slot->state > VC_SLOT_CONFIRMED || slot->size_bytes > record->flash->slot_bytes)
            return 0;
    }
    if (counter <= record->counter)
        return 0;
    record->counter = counter;
    record->entry = entry;
    return 1;
}

void vc_slot_record_open(vc_slot_record *record, const vc_flash *flash)
{
    unsigned piece;
    uint32_t place;
    memset(record, 0, sizeof *record);
    record->flash = flash;
    for (piece = 0; piece < 2; piece++)
        for (place = 0; place < places(flash); place++)
            if (read_entry(record, flash->base + place_offset(flash, piece, place)))
                record->newest = piece;
    record->piece = record->newest;
    /* A cut may have left part of an entry behind the newest one. Without any entry, the flash holds what it will. */
    record->place = places(flash);
    while (record->counter > 0 && record->place > 0 &&
           is_blank(flash->base + place_offset(flash, record->piece, record->place - 1), place_bytes(flash)))
        record->place--;
}

/* Writes bytes, filled up to whole writes, to the next place. A place is used once, whether or not the flash takes it.
 * Returns whether it did. */
static int put(vc_slot_record *record, const uint8_t *bytes)
{
    const vc_flash *flash = record->flash;
    if (record->place == places(flash)) {
        const unsigned other = !record->newest;
        if (flash->erase(flash->context, flash->record[other], flash->record_bytes) != 0)
            return 0;
        record->piece = other;
        record->place = 0;
    }
    return flash->program(flash->context, place_offset(flash, record->piece, record->place++), bytes,
                          place_bytes(flash)) == 0;
}

int vc_slot_record_append(vc_slot_record *record, const vc_slot_entry *entry)
{
    uint8_t bytes[VC_LEAST_RECORD_BYTES], *at = bytes + MAGIC_BYTES;
    unsigned i;
    memset(bytes, 0xFF, sizeof bytes);
    memcpy(bytes, magic, MAGIC_BYTES);
    vc_number_bytes(at, ++record->counter, 4);
    vc_number_bytes(at + 4, entry->lowest_number, 4);
    at += 8;
    for (i = 0; i < VC_SLOTS; i++, at += 6 + VC_SHA256_BYTES) {
        const vc_slot *slot = &entry->slots[i];
        at[0] = slot->state;
        at[1] = slot->booted;
        vc_number_bytes(at + 2, slot->size_bytes, 4);
        memcpy(at + 6, slot->sha256, VC_SHA256_BYTES);
    }
    vc_number_bytes(at, vc_crc32(bytes, CHECKED_BYTES, 0), CRC_BYTES);
    /* A place that a cut left half written may look blank and take nothing: the next one does. */
    if (!put(record, bytes) && !put(record, bytes))
        return 0;
    record->newest = record->piece;
    record->entry = *entry;
    return 1;
}
