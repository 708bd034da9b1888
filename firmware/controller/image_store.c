/* Two slots for model images in flash, and the record of their states; see image_store.h.
 *
 * The record is kept twice, each copy with a counter and a CRC-32; a change erases and writes the older copy, so a cut
 * leaves either the record before or the one after. A slot is erased and written only while the record calls it empty
 * or in writing, and neither the slot that runs nor the one to fall back to is.
 */
#include "image_store.h"

#include "common.h"
#include "crc.h"

#define ERASED 0xFFu
/* After a cut, programming resumes at a multiple of this, over bytes that may be half done. */
#define PAGE_BYTES 256u
#define NO_SLOT (-1)

/* Record: "VCFS", counter u32, then of each slot state u8, booted u8, size u32 and SHA-256, then CRC-32. */
enum { MAGIC_BYTES = 4, SLOT_BYTES = 6 + VC_SHA256_BYTES, CRC_BYTES = 4 };
enum { CHECKED_BYTES = MAGIC_BYTES + 4 + VC_SLOTS * SLOT_BYTES, RECORD_BYTES = CHECKED_BYTES + CRC_BYTES };

static const uint8_t magic[MAGIC_BYTES] = {'V', 'C', 'F', 'S'};
static const vc_slot empty_slot = {VC_SLOT_EMPTY, 0, 0, {0}};

static const uint8_t *slot_data(const vc_image_store *store, unsigned number)
{
    return store->flash->base + store->flash->slot[number];
}

/* Uses a copy of the record if it is whole and newer than the last one. */
static void read_record(vc_image_store *store, const uint8_t *record)
{
    vc_fields fields;
    vc_slot slots[VC_SLOTS];
    uint32_t counter;
    unsigned i;
    if (!vc_same_bytes(record, magic, MAGIC_BYTES) ||
        vc_crc32(record, CHECKED_BYTES, 0) != vc_number(record + CHECKED_BYTES, CRC_BYTES))
        return;
    vc_fields_begin(&fields, record + MAGIC_BYTES, CHECKED_BYTES - MAGIC_BYTES);
    counter = (uint32_t)vc_take_number(&fields, 4);
    for (i = 0; i < VC_SLOTS; i++) {
        slots[i].state = (uint8_t)vc_take_number(&fields, 1);
        slots[i].booted = (uint8_t)vc_take_number(&fields, 1);
        slots[i].size_bytes = (uint32_t)vc_take_number(&fields, 4);
        memcpy(slots[i].sha256, vc_take_piece(&fields, VC_SHA256_BYTES).bytes, VC_SHA256_BYTES);
        if (slots[i].state > VC_SLOT_CONFIRMED || slots[i].size_bytes > store->flash->slot_bytes)
            return;
    }
    if (counter > store->counter) {
        store->counter = counter;
        memcpy(store->slots, slots, sizeof slots);
    }
}

/* Changes slots' states, all at once. The record comes first, so that a failing flash changes nothing. Returns whether
 * the flash took it. */
static int set_slots(vc_image_store *store, const vc_slot *slots)
{
    const vc_flash *flash = store->flash;
    uint32_t counter = store->counter + 1, address = flash->record[counter & 1u];
    uint8_t record[RECORD_BYTES], *at = record;
    unsigned i;
    memcpy(at, magic, MAGIC_BYTES);
    vc_number_bytes(at + MAGIC_BYTES, counter, 4);
    at += MAGIC_BYTES + 4;
    for (i = 0; i < VC_SLOTS; i++, at += SLOT_BYTES) {
        at[0] = slots[i].state;
        at[1] = slots[i].booted;
        vc_number_bytes(at + 2, slots[i].size_bytes, 4);
        memcpy(at + 6, slots[i].sha256, VC_SHA256_BYTES);
    }
    vc_number_bytes(at, vc_crc32(record, CHECKED_BYTES, 0), CRC_BYTES);
    if (flash->erase(flash->context, address, flash->record_bytes) != 0 ||
        flash->program(flash->context, address, record, RECORD_BYTES) != 0)
        return 0;
    store->counter = counter;
    memcpy(store->slots, slots, sizeof store->slots);
    for (i = 0; i < VC_SLOTS; i++)
        if (slots[i].state == VC_SLOT_EMPTY) {
            store->written[i] = 0;
            store->whole[i] = 0;
        }
    return 1;
}

static int set_slot(vc_image_store *store, unsigned number, const vc_slot *slot)
{
    vc_slot slots[VC_SLOTS];
    memcpy(slots, store->slots, sizeof slots);
    slots[number] = *slot;
    return set_slots(store, slots);
}

/* Checks a slot's image, and reads it in place. Returns 0 for a whole one, or the rejection's code. */
static int look_at_image(vc_image_store *store, unsigned number, vc_rejection *rejection)
{
    const vc_slot *slot = &store->slots[number];
    uint8_t sha256[VC_SHA256_BYTES];
    int rejected;
    store->whole[number] = 0;
    vc_sha256(slot_data(store, number), slot->size_bytes, sha256);
    if (!vc_same_bytes(sha256, slot->sha256, VC_SHA256_BYTES))
        return vc_reject(rejection, VC_IMAGE_REJECTED,
                         "what was written has another SHA-256 than announced: flash it again");
    rejected = vc_model_image_read(&store->images[number], slot_data(store, number), slot->size_bytes, rejection);
    store->whole[number] = !rejected;
    return rejected;
}

/* The slot in this state with a whole image, or NO_SLOT. */
static int whole_slot(const vc_image_store *store, uint8_t state)
{
    int number;
    for (number = 0; number < VC_SLOTS; number++)
        if (store->slots[number].state == state && store->whole[number])
            return number;
    return NO_SLOT;
}

/* The offset at which an upload resumes after a boot: the start of the last page that is not blank. */
static uint32_t programmed_bytes(const vc_image_store *store, unsigned number)
{
    const uint8_t *data = slot_data(store, number);
    uint32_t length = store->slots[number].size_bytes;
    while (length > 0 && data[length - 1] == ERASED)
        length--;
    return length > 0 ? (length - 1) / PAGE_BYTES * PAGE_BYTES : 0;
}

void vc_image_store_boot(vc_image_store *store, const vc_flash *flash, const char *hardware, vc_payload_check check,
                         const void *check_context)
{
    vc_slot slots[VC_SLOTS];
    vc_rejection unused;
    int changed = 0, spare;
    unsigned i;
    memset(store, 0, sizeof *store);
    store->flash = flash;
    store->hardware = hardware;
    store->check = check;
    store->check_context = check_context;
    for (i = 0; i < 2; i++)
        read_record(store, flash->base + flash->record[i]);
    for (i = 0; i < VC_SLOTS; i++) {
        if (store->slots[i].state > VC_SLOT_WRITING)
            look_at_image(store, i, &unused);
        store->written[i] = programmed_bytes(store, i);
    }
    /* Notes broken images. Ends a trial that was not confirmed; notes the first start of a new one. */
    memcpy(slots, store->slots, sizeof slots);
    spare = whole_slot(store, VC_SLOT_VERIFIED);
    for (i = 0; i < VC_SLOTS; i++) {
        vc_slot *slot = &slots[i];
        if (slot->state != VC_SLOT_TESTING && slot->state != VC_SLOT_CONFIRMED)
            continue;
        if (!store->whole[i]) {
            if (slot->state == VC_SLOT_CONFIRMED && spare != NO_SLOT)
                slots[spare].state = VC_SLOT_CONFIRMED;
            *slot = empty_slot;
            changed = 1;
        } else if (slot->state == VC_SLOT_TESTING) {
            slot->state = slot->booted ? VC_SLOT_VERIFIED : VC_SLOT_TESTING;
            slot->booted = !slot->booted;
            changed = 1;
        }
    }
    store->running = NO_SLOT;
    /* Without a record of it, a test would never end. */
    if (!changed || set_slots(store, slots))
        store->running = whole_slot(store, VC_SLOT_TESTING);
    if (store->running == NO_SLOT)
        store->running = whole_slot(store, VC_SLOT_CONFIRMED);
}

const vc_model_image *vc_image_store_running(const vc_image_store *store)
{
    return store->running == NO_SLOT ? NULL : &store->images[store->running];
}

const uint8_t *vc_image_store_running_sha256(const vc_image_store *store)
{
    return store->running == NO_SLOT ? NULL : store->slots[store->running].sha256;
}

void vc_image_store_describe(const vc_image_store *store, unsigned number, vc_image_description *description)
{
    memset(description, 0, sizeof *description);
    description->slot = (uint8_t)number;
    description->state = store->slots[number].state;
    description->sha256 = store->slots[number].sha256;
    if (description->state > VC_SLOT_WRITING && store->whole[number]) {
        description->name = store->images[number].name;
        description->version = store->images[number].version;
    }
}

static int no_such_slot(unsigned number, vc_rejection *rejection)
{
    return number < VC_SLOTS ? 0
                             : vc_reject_numbers(rejection, VC_NO_SUCH_SLOT, "there is no slot #; slots are 0 to #",
                                                 number, VC_SLOTS - 1);
}

static int not_in_state(const vc_image_store *store, unsigned number, uint8_t state, const char *hint,
                        vc_rejection *rejection)
{
    static const char *const names[] = {"empty", "writing", "verified", "testing", "confirmed"};
    int rejected = no_such_slot(number, rejection);
    if (rejected || store->slots[number].state == state)
        return rejected;
    vc_reject_numbers(rejection, VC_WRONG_STATE, "slot # is ", number, 0);
    vc_rejection_add(rejection, names[store->slots[number].state]);
    return vc_rejection_add(rejection, hint);
}

static int flash_failed(vc_rejection *rejection)
{
    return vc_reject(rejection, VC_FLASH_FAILED,
                     "the flash did not take the data: try again; if it goes on failing, the flash is worn out");
}

static int wrong_hardware(const vc_image_store *store, vc_piece wanted, enum vc_error_code code,
                          vc_rejection *rejection)
{
    vc_piece hardware = vc_text_piece(store->hardware);
    if (wanted.length == 0 ||
        (wanted.length == hardware.length && vc_same_bytes(wanted.bytes, hardware.bytes, wanted.length)))
        return 0;
    vc_reject(rejection, code, "this controller is ");
    vc_rejection_add_piece(rejection, hardware);
    vc_rejection_add(rejection, ", the image is for ");
    return vc_rejection_add_piece(rejection, wanted);
}

static uint32_t next_offset(const vc_image_store *store, unsigned number)
{
    return store->slots[number].state == VC_SLOT_WRITING ? store->written[number] : 0;
}

static int tell(const vc_image_store *store, unsigned number, vc_flash_status *report)
{
    const vc_slot *slot = &store->slots[number];
    report->slot = (uint8_t)number;
    report->state = slot->state;
    report->next_offset = next_offset(store, number);
    report->sha256 = slot->state > VC_SLOT_WRITING ? slot->sha256 : NULL;
    return 0;
}

int vc_image_store_begin(vc_image_store *store, const vc_flash_begin *begin, vc_flash_status *report,
                         vc_rejection *rejection)
{
    const vc_flash *flash = store->flash;
    const vc_slot *slot;
    vc_slot wanted = {VC_SLOT_WRITING, 0, begin->size_bytes, {0}};
    int rejected = no_such_slot(begin->slot, rejection);
    if (rejected)
        return rejected;
    slot = &store->slots[begin->slot];
    if ((int)begin->slot == store->running || slot->state == VC_SLOT_CONFIRMED)
        return vc_reject_numbers(rejection, VC_WRONG_STATE, "slot # runs or is the one to fall back to: use the other",
                                 begin->slot, 0);
    rejected = wrong_hardware(store, begin->hardware, VC_WRONG_HARDWARE, rejection);
    if (rejected)
        return rejected;
    if (begin->size_bytes == 0 || begin->size_bytes > flash->slot_bytes)
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS, "an image of # bytes; a slot holds 1 to #",
                                 begin->size_bytes, flash->slot_bytes);
    memcpy(wanted.sha256, begin->sha256, VC_SHA256_BYTES);
    if (slot->state != VC_SLOT_WRITING || slot->size_bytes != wanted.size_bytes ||
        !vc_same_bytes(slot->sha256, wanted.sha256, VC_SHA256_BYTES)) {
        if (!set_slot(store, begin->slot, &empty_slot) ||
            flash->erase(flash->context, flash->slot[begin->slot], flash->slot_bytes) != 0 ||
            !set_slot(store, begin->slot, &wanted))
            return flash_failed(rejection);
    }
    return tell(store, begin->slot, report);
}

int vc_image_store_write(vc_image_store *store, const vc_flash_data *data, vc_flash_status *report,
                         vc_rejection *rejection)
{
    const vc_flash *flash = store->flash;
    int rejected = not_in_state(store, data->slot, VC_SLOT_WRITING, ": begin with FlashBegin", rejection);
    if (rejected)
        return rejected;
    if (data->offset == next_offset(store, data->slot)) {
        uint32_t size_bytes = store->slots[data->slot].size_bytes;
        if (data->data.length > size_bytes - data->offset)
            return vc_reject_numbers(rejection, VC_BAD_VALUE, "data up to byte # of an image of # bytes",
                                     data->offset + (uint64_t)data->data.length, size_bytes);
        if (flash->program(flash->context, flash->slot[data->slot] + data->offset, data->data.bytes,
                           (uint32_t)data->data.length) != 0)
            return flash_failed(rejection);
        store->written[data->slot] = data->offset + (uint32_t)data->data.length;
    }
    return tell(store, data->slot, report);
}

/* Checks the image in a slot. Returns 0, or the rejection's code. */
static int check_image(vc_image_store *store, unsigned number, vc_rejection *rejection)
{
    const vc_model_image *image = &store->images[number];
    int rejected = look_at_image(store, number, rejection);
    if (!rejected)
        rejected = wrong_hardware(store, image->hardware, VC_IMAGE_REJECTED, rejection);
    if (!rejected)
        rejected =
            store->check(store->check_context, image->codec, image->payload.bytes, image->payload.length, rejection);
    return rejected;
}

int vc_image_store_verify(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection)
{
    vc_slot verified;
    int rejected = not_in_state(store, number, VC_SLOT_WRITING, ": there is nothing new to verify", rejection);
    if (rejected)
        return rejected;
    rejected = check_image(store, number, rejection);
    if (rejected)
        return set_slot(store, number, &empty_slot) ? rejected : flash_failed(rejection);
    verified = store->slots[number];
    verified.state = VC_SLOT_VERIFIED;
    return set_slot(store, number, &verified) ? tell(store, number, report) : flash_failed(rejection);
}

int vc_image_store_activate(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection)
{
    vc_slot tested;
    unsigned i;
    int rejected = not_in_state(store, number, VC_SLOT_VERIFIED, ": verify it first", rejection);
    if (rejected)
        return rejected;
    for (i = 0; i < VC_SLOTS; i++)
        if (store->slots[i].state == VC_SLOT_TESTING)
            return vc_reject(rejection, VC_WRONG_STATE,
                             "another slot is being tested: confirm it, or restart to revert");
    tested = store->slots[number];
    tested.state = VC_SLOT_TESTING;
    return set_slot(store, number, &tested) ? tell(store, number, report) : flash_failed(rejection);
}

int vc_image_store_confirm(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection)
{
    vc_slot slots[VC_SLOTS];
    unsigned i;
    int rejected = no_such_slot(number, rejection);
    if (rejected)
        return rejected;
    if ((int)number != store->running)
        return vc_reject_numbers(rejection, VC_WRONG_STATE, "slot # does not run: only what has been tried can be kept",
                                 number, 0);
    if (store->slots[number].state == VC_SLOT_TESTING) {
        memcpy(slots, store->slots, sizeof slots);
        for (i = 0; i < VC_SLOTS; i++)
            if (slots[i].state == VC_SLOT_CONFIRMED)
                slots[i].state = VC_SLOT_VERIFIED;
        slots[number].state = VC_SLOT_CONFIRMED;
        slots[number].booted = 0;
        if (!set_slots(store, slots))
            return flash_failed(rejection);
    }
    return tell(store, number, report);
}
