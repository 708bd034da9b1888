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

static uint32_t places(const vc_flash *flash)
{
    return flash->record_bytes / VC_SLOT_ENTRY_BYTES;
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
            if (read_entry(record, flash->base + flash->record[piece] + place * VC_SLOT_ENTRY_BYTES))
                record->newest = piece;
    record->piece = record->newest;
    /* A cut may have left part of an entry behind the newest one. Without any entry, the flash holds what it will. */
    record->place = places(flash);
    while (record->counter > 0 && record->place > 0 &&
           is_blank(flash->base + flash->record[record->piece] + (record->place - 1) * VC_SLOT_ENTRY_BYTES,
                    VC_SLOT_ENTRY_BYTES))
        record->place--;
}

int vc_slot_record_append(vc_slot_record *record, const vc_slot_entry *entry)
{
    const vc_flash *flash = record->flash;
    uint8_t bytes[VC_SLOT_ENTRY_BYTES], *at = bytes + MAGIC_BYTES;
    unsigned i;
    uint32_t address;
    if (record->place == places(flash)) {
        const unsigned other = !record->newest;
        if (flash->erase(flash->context, flash->record[other], flash->record_bytes) != 0)
            return 0;
        record->piece = other;
        record->place = 0;
    }
    /* A place and a counter are used once, whether or not the flash takes them. */
    address = flash->record[record->piece] + record->place++ * VC_SLOT_ENTRY_BYTES;
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
    if (flash->program(flash->context, address, bytes, sizeof bytes) != 0)
        return 0;
    record->newest = record->piece;
    record->entry = *entry;
    return 1;
}
