// One step of a row's ring, or its beginning, after the C++ of draws.
//
// Rows of the ring are bytes, so that one kernel serves every dtype. The lanes of a row copy words of 16, 4 or 1 bytes,
// a few at once, as the GPU waits for all of them together; on the CPU one lane copies whole parts.

struct alignas(16) Wide { unsigned word[4]; };
const int num_bytes = a.num_bytes, num_slots = a.num_slots, num_frames = a.num_frames, lanes = a.lanes;
long long* age = (long long*)a.age + row;
const long long before = *age;
// All lanes of a row have to read the age before one of them counts on.
#if defined(__CUDA_ARCH__)
    if (lanes == 32) __syncwarp(); else __syncthreads();
#endif
const bool resets = a.mask != 0;
const bool writes = !resets || ((const unsigned char*)a.mask)[row];
const long long now = resets ? 0 : before + 1;
if (lane == 0 && writes && a.counts) *age = now;
if (lane == 0 && resets && writes && a.draw_count) {
    const long long count = ++((long long*)a.draw_count)[row];
    const RowKey key = key_of(*(const long long*)a.seed, a.stream, count, a.first_row + row);
    const unsigned long long bits = bits_of(key, 0u);
    ((long long*)a.lag)[row] = a.lowest + (long long)((bits * (unsigned)a.span) >> 32);
}
// Whole numbers of 32 bits divide much faster.
const int slot = now >> 32 ? (int)(now % (unsigned)num_slots) : (int)((unsigned)now % (unsigned)num_slots);
const long long newest = a.lag && !resets ? ((const long long*)a.lag)[row] : 0;
const long long stride = resets ? 0 : a.stride;
unsigned char* ring = (unsigned char*)a.ring + (long long)row * num_slots * num_bytes;
const unsigned char* value = (const unsigned char*)a.value + (long long)row * a.value_stride;
unsigned char* out = (unsigned char*)a.out + (long long)row * num_frames * num_bytes;

auto frame_of = [=](int frame) {
    const long long wanted = newest + (num_frames - 1 - frame) * stride;
    const int lag = (int)(wanted < now ? wanted : now), from = slot - lag;
    return lag == 0 ? value : ring + (long long)(from < 0 ? from + num_slots : from) * num_bytes;
};
auto copy_words = [=](auto zero) {
    using Word = decltype(zero);
    const int AT_ONCE = 4;
    Word* slot_words = (Word*)(ring + (long long)slot * num_bytes);
    const int words_per_row = num_bytes / (int)sizeof(Word);
    if (writes)
        for (int word = lane; word < words_per_row; word += lanes) slot_words[word] = ((const Word*)value)[word];
    Word* to = (Word*)out;
    int offset = 0;
    for (int part = 0; part < a.num_parts; ++part) {
        const unsigned words = (a.parts ? ((const int*)a.parts)[part] : num_bytes) / (unsigned)sizeof(Word);
        const int items = num_frames * (int)words;
        for (int begin = lane; begin < items; begin += AT_ONCE * lanes) {
            Word found[AT_ONCE];
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const unsigned item = begin + k * lanes, frame = item / words;
                if (item < items) found[k] = ((const Word*)frame_of(frame))[offset + item - frame * words];
            }
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k)
                if (begin + k * lanes < items) to[begin + k * lanes] = found[k];
        }
        to += items;
        offset += words;
    }
};
if (a.width == 16) copy_words(Wide());
else if (a.width == 4) copy_words(0u);
else if (a.width == 1) copy_words((unsigned char)0);
else {
    if (writes) memcpy(ring + (long long)slot * num_bytes, value, num_bytes);
    for (int frame = 0; frame < num_frames; ++frame) {
        const unsigned char* from = frame_of(frame);
        int offset = 0;
        for (int part = 0; part < a.num_parts; ++part) {
            const int size = a.parts ? ((const int*)a.parts)[part] : num_bytes;
            memcpy(out + offset * num_frames + frame * size, from + offset, size);
            offset += size;
        }
    }
}
