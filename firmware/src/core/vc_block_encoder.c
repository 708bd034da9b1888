/* Encoder of blocks: a search for the levels of least distortion + lambda * rate, then the decoder's steps mirrored;
 * see vc_block_coder.h. */
#include "vc_block_coder.h"
#include "vc_mdct_mixing.h"

#define STATES 4
#define UNREACHED (INT64_MAX / 4) /* so that costs can be added */
#define LARGEST_ERROR (1 << 26)
/* Below this magnitude, in 1/256 step, the search tests zero only where another index takes more than COSTLY / 256
 * bits. Half of all bins are such, and the result is as good. */
#define SMALL 128
#define COSTLY (3 * 256)

/* The best way into a state of dependent quantisation. */
typedef struct {
    int64_t cost; /* squared error + lambda * rate, in 1/65536 of a squared step */
    vc_below below;
} path;

/* An index that a path may take next, the cost with it, and its level. */
typedef struct {
    int64_t cost;
    uint32_t index, level;
} choice;

/* Context of the search for one block. */
typedef struct {
    vc_model *model;
    const vc_history *history;
    vc_block_search *search;
    uint32_t bins, lambda;
} task;

/* Rates in 1/256 bit of the answers of decisions 0 to `last`, before the model learns from this block. */
static void estimate(const task *task, const vc_contexts *contexts, unsigned quantiser, uint32_t first, uint32_t last,
                     uint32_t *no, uint32_t *yes)
{
    vc_prediction prediction;
    uint32_t decision;
    for (decision = first; decision < VC_KINDS && decision <= last; decision++) {
        const uint32_t mixed = vc_mix(task->model, contexts, decision, quantiser, &prediction);
        yes[decision] = vc_rate[mixed];
        no[decision] = vc_rate[1023 - mixed]; /* vc_squash is symmetric */
    }
}

/* Estimated rate of an index above 0 in 1/256 bit, by the rates of its decisions. */
static uint32_t estimated_rate(const uint32_t *no, const uint32_t *yes, uint32_t index)
{
    const uint32_t unary = index < VC_UNARY_LIMIT ? index : VC_UNARY_LIMIT;
    uint32_t rate = 256 + yes[0], decision;
    for (decision = 1; decision < unary && decision < VC_KINDS - 1; decision++)
        rate += yes[decision];
    if (unary >= VC_KINDS)
        rate += (unary - (VC_KINDS - 1)) * yes[VC_KINDS - 1];
    if (index < VC_UNARY_LIMIT)
        return rate + no[index < VC_KINDS ? index : VC_KINDS - 1];
    return rate + 256 * (1 + 2 * vc_floor_log2(index - VC_UNARY_LIMIT + 1));
}

/* Squared error of zero, in 1/65536 of a squared step; limited so that the sum over a block stays below UNREACHED. */
static int64_t error_of_zero(uint32_t magnitude)
{
    const int64_t limited = magnitude < LARGEST_ERROR ? magnitude : LARGEST_ERROR;
    return limited * limited;
}

/* The choice of an index above 0 next to a magnitude. */
static choice choice_of(const task *task, unsigned centroid_class, uint32_t magnitude, unsigned quantiser,
                        uint32_t index, uint32_t rate)
{
    const uint32_t level = vc_level_of(index, quantiser);
    const int32_t error =
        (int32_t)(magnitude - level * 256) - vc_level_offset(task->model, quantiser, centroid_class, level);
    const choice made = {(int64_t)error * error + (int64_t)task->lambda * rate, index, level};
    return made;
}

/* Finds the best even index and the best odd one of bin k for a path. They are those around the magnitude, or zero. */
static void extend(const task *task, uint32_t k, uint32_t magnitude, unsigned state, const path *from, choice *choices)
{
    const unsigned quantiser = vc_quantiser_of(state);
    const uint32_t nearest = (magnitude / 256 + quantiser) / 2;
    const choice unreached = {UNREACHED, 0, 0};
    uint32_t no[VC_KINDS], yes[VC_KINDS];
    vc_contexts *const contexts = &task->search->contexts[k][state];
    choice zero = {error_of_zero(magnitude), 0, 0};
    choices[0] = choices[1] = unreached;
    if (from->cost == UNREACHED)
        return;
    vc_contexts_find(contexts, &task->search->bin[k], k, &from->below);
    estimate(task, contexts, quantiser, 0, 0, no, yes);
    zero.cost += (int64_t)task->lambda * no[0];
    if (nearest == 0 && magnitude < (quantiser ? SMALL : 2 * SMALL) && yes[0] > COSTLY) {
        choices[0] = zero;
    } else {
        estimate(task, contexts, quantiser, 1, nearest + 1, no, yes);
        if (nearest == 0)
            choices[0] = zero;
        else
            choices[nearest & 1u] = choice_of(task, contexts->centroid_class, magnitude, quantiser, nearest,
                                              estimated_rate(no, yes, nearest));
        choices[(nearest + 1) & 1u] = choice_of(task, contexts->centroid_class, magnitude, quantiser, nearest + 1,
                                                estimated_rate(no, yes, nearest + 1));
        if (nearest == 1 && zero.cost < choices[0].cost)
            choices[0] = zero;
        choices[1].cost += from->cost;
    }
    choices[0].cost += from->cost;
}

/* Takes the best way into each state by bin k. */
static void advance(const task *task, uint32_t k, uint32_t magnitude, const path *paths, path *longer)
{
    choice choices[STATES][2];
    unsigned state;
    for (state = 0; state < STATES; state++)
        extend(task, k, magnitude, state, &paths[state], choices[state]);
    for (state = 0; state < STATES; state++) {
        /* Two states lead into each, one by an even index and one by an odd index; see vc_next_state. */
        const unsigned by_even = state == 0 ? 0 : state == 1 ? 2 : state == 2 ? 1 : 3, by_odd = by_even ^ 1u;
        const int odd = choices[by_odd][1].cost < choices[by_even][0].cost;
        const unsigned from = odd ? by_odd : by_even;
        const choice *const best = &choices[from][odd];
        longer[state].cost = best->cost;
        longer[state].below = paths[from].below;
        vc_below_add(&longer[state].below, vc_kept_magnitude(best->level));
        task->search->chosen[k][state] = best->index;
        task->search->origin[k][state] = (uint8_t)from;
    }
}

/* Chooses the indices of one block by a Viterbi search from a state of dependent quantisation. Returns 1 if silence is
 * the best choice for the block. */
static int search_block(const task *task, unsigned first_state, const uint32_t *magnitudes)
{
    const uint32_t silence = vc_place_of(vc_stretched(vc_silence_predict(task->model, task->history)) / 4);
    path paths[2][STATES];
    path *now = paths[0], *next = paths[1];
    int64_t silent_cost = (int64_t)task->lambda * vc_rate[silence];
    uint32_t k, largest = 0, any = 0;
    unsigned state, best = 0;
    for (k = 0; k < task->bins; k++)
        if (magnitudes[k] > largest)
            largest = magnitudes[k];
    if (largest < 128)
        return 1;
    for (state = 0; state < STATES; state++)
        now[state].cost = UNREACHED;
    now[first_state].cost = (int64_t)task->lambda * vc_rate[1023 - silence];
    memset(&now[first_state].below, 0, sizeof now[first_state].below);
    for (k = 0; k < task->bins; k++) {
        path *swap = now;
        silent_cost += error_of_zero(magnitudes[k]);
        advance(task, k, magnitudes[k], now, next);
        now = next;
        next = swap;
    }
    for (state = 1; state < STATES; state++)
        if (now[state].cost < now[best].cost)
            best = state;
    if (silent_cost < now[best].cost)
        return 1;
    for (k = task->bins; k-- > 0; best = task->search->origin[k][best]) {
        task->search->indices[k] = task->search->chosen[k][best];
        any |= task->search->indices[k];
    }
    return any == 0;
}

static void encode_decision(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned decision,
                            unsigned quantiser, int bit)
{
    vc_prediction prediction;
    vc_range_encode(coder, bit, vc_predict(model, contexts, decision, quantiser, &prediction));
    vc_update(&prediction, bit);
}

static void encode_index(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned quantiser,
                         uint32_t index)
{
    uint32_t decision;
    for (decision = 0; decision <= index && decision < VC_UNARY_LIMIT; decision++)
        encode_decision(coder, model, contexts, decision, quantiser, index > decision);
    if (index >= VC_UNARY_LIMIT)
        vc_golomb_encode(coder, index - VC_UNARY_LIMIT);
}

/* Writes the block of search->indices, with the signs of `values`. */
static void write_block(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                        uint32_t bins, const uint32_t *magnitudes, const int32_t *values, int silent)
{
    vc_history *history = &state->history;
    vc_below below = {0, 0};
    uint32_t k;
    vc_range_encode(coder, silent, vc_silence_predict(model, history));
    vc_silence_update(model, history, silent);
    history->silent_history = (uint8_t)((history->silent_history << 1 | silent) & 3);
    if (silent)
        state->state = 0;
    for (k = 0; k < bins && !silent; k++) {
        unsigned quantiser = vc_quantiser_of(state->state);
        uint32_t index = search->indices[k], level = vc_level_of(index, quantiser);
        vc_contexts *const contexts = &search->contexts[k][state->state];
        if (magnitudes == NULL) /* otherwise the search has found them */
            vc_contexts_find(contexts, &search->bin[k], k, &below);
        search->offsets[k] = vc_level_offset(model, quantiser, contexts->centroid_class, level);
        if (search->sums != NULL && magnitudes != NULL && level > 0) {
            const unsigned row = (level < VC_CENTROID_LEVELS ? level : VC_CENTROID_LEVELS) - 1;
            search->sums->sum[quantiser][row][contexts->centroid_class] +=
                (int64_t)magnitudes[k] - (int64_t)level * 256;
            search->sums->count[quantiser][row][contexts->centroid_class]++;
        }
        encode_index(coder, model, contexts, quantiser, index);
        if (index != 0)
            vc_range_encode(coder, values[k] < 0, VC_EVEN_ODDS);
        state->state = vc_next_state(state->state, index);
        vc_below_add(&below, vc_history_set(history, k, level));
    }
    vc_history_next_block(history, bins);
}

static void find_bins(vc_block_search *search, const vc_history *history, uint32_t bins)
{
    uint32_t k, means_below = 0;
    for (k = 0; k < bins; k++)
        vc_bin_find(&search->bin[k], history, bins, k, &means_below);
}

void vc_block_encode(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                     uint32_t bins, const uint32_t *magnitudes, const int32_t *values, uint32_t lambda)
{
    const task task = {model, &state->history, search, bins, lambda};
    find_bins(search, &state->history, bins);
    write_block(coder, model, state, search, bins, magnitudes, values, search_block(&task, state->state, magnitudes));
}

void vc_block_write(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                    uint32_t bins, const int32_t *levels, int silent)
{
    unsigned now = state->state;
    uint32_t k;
    find_bins(search, &state->history, bins);
    for (k = 0; k < bins; k++) {
        const uint32_t level = (uint32_t)(levels[k] < 0 ? -levels[k] : levels[k]);
        search->indices[k] = level == 0 ? 0 : (level + vc_quantiser_of(now)) / 2;
        now = vc_next_state(now, search->indices[k]);
    }
    write_block(coder, model, state, search, bins, NULL, levels, silent);
}
