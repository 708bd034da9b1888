/* Adaptive binary arithmetic coding of EVA's latents, the same decisions in encoder and decoder; see vc_eva_latents.h.
 */
#include "vc_eva_latents.h"

/* Columns after a refresh at which adaptation slows down. After n columns the best rate is 1 / n, and textures change
 * too fast for a rate below 1/32. */
#define FAST_COLUMNS 8u
#define MEDIUM_COLUMNS 24u
#define FAST_SHIFT 3u
#define NO_ADAPTATION 16u /* a shift that leaves 0 */

void vc_eva_contexts_reset(vc_eva_contexts *contexts, const vc_eva_model *model)
{
    uint32_t latent, decision;
    contexts->columns = 0;
    for (latent = 0; latent < model->latents; latent++)
        for (decision = 0; decision < VC_EVA_DECISIONS; decision++)
            contexts->probabilities[latent][decision] = vc_eva_probability(model, latent, decision);
}

static unsigned adaptation_shift(const vc_eva_contexts *contexts, const vc_eva_model *model)
{
    if (!model->adapts)
        return NO_ADAPTATION;
    return FAST_SHIFT + (contexts->columns >= FAST_COLUMNS) + (contexts->columns >= MEDIUM_COLUMNS);
}

static int32_t code_level(vc_range_coder *coder, int encoding, uint16_t *probabilities, unsigned shift, int32_t level)
{
    const uint32_t wanted = level < 0 ? 0u - (uint32_t)level : (uint32_t)level; /* if encoding */
    const uint32_t limited = wanted < VC_EVA_MAX_LEVEL ? wanted : VC_EVA_MAX_LEVEL;
    uint32_t magnitude = 0;
    while (magnitude < VC_UNARY_LIMIT &&
           vc_adaptive_code(coder, encoding, limited > magnitude, &probabilities[magnitude], shift))
        magnitude++;
    if (magnitude == VC_UNARY_LIMIT) {
        if (encoding)
            vc_golomb_encode(coder, limited - VC_UNARY_LIMIT);
        else
            magnitude += vc_golomb_decode(coder);
    }
    if (magnitude != 0 && vc_adaptive_code(coder, encoding, level < 0, &probabilities[VC_UNARY_LIMIT], shift))
        return -(int32_t)magnitude;
    return (int32_t)magnitude;
}

void vc_eva_code_column(vc_range_coder *coder, int encoding, vc_eva_contexts *contexts, const vc_eva_model *model,
                        int32_t *levels)
{
    const unsigned shift = adaptation_shift(contexts, model);
    uint32_t k;
    for (k = 0; k < model->latents; k++) {
        const int32_t level = code_level(coder, encoding, contexts->probabilities[k], shift, encoding ? levels[k] : 0);
        if (!encoding)
            levels[k] = level;
    }
    if (contexts->columns < MEDIUM_COLUMNS)
        contexts->columns++;
}
